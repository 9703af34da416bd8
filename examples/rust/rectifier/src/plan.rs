//! Which views of a frame are cut, and when that stops.

use flockeye_config::Resolved;
use flockeye_contract::{NONE, PlanHeader, PlannedView, StopReason, StopRule, ViewKind};

/// Views in the order in which they are to be cut.
#[derive(Clone)]
pub struct Plan {
    /// What it says of all of them.
    pub header: PlanHeader,
    /// The views.
    pub views: Vec<PlannedView>,
}

/// How far a frame has come.
pub struct Progress {
    /// Views that were given to a worker.
    pub issued: u32,
    /// Whether one of them showed a marker of a neighbour.
    pub has_hit: bool,
    /// Whether a newer frame waits.
    pub is_newer_there: bool,
    /// Whether nothing may depend on time.
    pub is_lossless: bool,
}

impl Plan {
    /// The tiles of the sphere from tile `first` on: for a frame for which there is no plan.
    pub fn sweep(resolved: &Resolved, first: usize) -> Self {
        let tiles = resolved.partition_views.iter().zip(0..);
        let planned = tiles.map(|(view, tile)| PlannedView {
            camera_from_view: view.camera_from_view.coords.into(),
            focal_px: view.focal_px,
            size_px: view.size_px,
            kind: ViewKind::Partition.code(),
            tile,
            target: NONE,
            ..PlannedView::default()
        });
        let mut views: Vec<_> = planned.collect();
        let first = first % views.len().max(1);
        views.rotate_left(first);
        let stop_rule = StopRule::Deadline.code();
        Self { header: PlanHeader { stop_rule, view_budget: 1, ..PlanHeader::default() }, views }
    }

    /// Why no more views are given; `None`: more are.
    pub fn reason_to_stop(&self, so_far: &Progress) -> Option<StopReason> {
        let is_rule = |rule: StopRule| self.header.stop_rule == rule.code();
        if is_rule(StopRule::FirstHit) && so_far.has_hit {
            return Some(StopReason::Hit);
        }
        let Some(next) = self.views.get(so_far.issued as usize) else {
            return Some(StopReason::Complete);
        };
        if !is_rule(StopRule::Deadline) || so_far.issued == 0 {
            return None;
        }
        if so_far.is_lossless {
            return (so_far.issued >= self.header.view_budget).then_some(StopReason::Budget);
        }
        // Regions of interest are cut even if a newer frame waits.
        let may_stop = so_far.is_newer_there && next.kind != ViewKind::Gaze.code();
        may_stop.then_some(StopReason::Newer)
    }
}
