//! How often each part of the sphere is searched, from the plans and the detection records.
//!
//! An untracked target is found when the part of the sphere that shows it is searched next. So the
//! longest time between two searches of one part bounds how many frames such a target waits.

use std::collections::VecDeque;
use std::fmt;

use flockeye_config::Resolved;
use flockeye_contract::{DetectionHeader, PlannedView};
use flockeye_geometry::view::View;
use serde::Serialize;

/// Plans that detection records may still refer to.
const PLANS_KEPT: usize = 64;

/// Frames between two searches of one part of the sphere.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SearchGaps {
    /// How many parts there are.
    pub views: usize,
    /// Their mean. A part counts once it was searched twice.
    pub mean_frames: Option<f64>,
    /// The longest. It includes gaps that still last, and those before a part's first search.
    pub worst_frames: u64,
}

/// How often the sphere is searched.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SweepReport {
    /// Frames from the first search to the newest.
    pub frames: u64,
    /// The partitions.
    pub partitions: SearchGaps,
    /// The far views, where there are any.
    pub far_views: Option<SearchGaps>,
}

impl fmt::Display for SweepReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let every = |gaps: &SearchGaps| {
            let mean = gaps.mean_frames.map_or("-".to_owned(), |mean| format!("{mean:.1}"));
            format!("every {mean} frames ({} at most)", gaps.worst_frames)
        };
        write!(f, "each partition {}", every(&self.partitions))?;
        match &self.far_views {
            Some(far) => write!(f, ", each far view {}", every(far)),
            None => Ok(()),
        }
    }
}

/// When each part of the sphere was searched.
#[derive(Debug)]
pub struct Sweep {
    /// How many parts are partitions. Those after them are far views.
    partitions: usize,
    /// `None` for a part that the camera does not see: it is never searched.
    parts: Vec<Option<SweptPart>>,
    /// For each plan, the part that each of its views shows.
    plans: VecDeque<(u64, Vec<u32>)>,
    /// The source's generation and epoch. Frame numbers are comparable within one epoch only.
    epoch: Option<(u32, u32)>,
    first: Option<u64>,
    newest: u64,
}

#[derive(Debug, Clone, Copy, Default)]
struct SweptPart {
    last: Option<u64>,
    sum: u64,
    gaps: u64,
    worst: u64,
}

impl Sweep {
    /// Starts with no search. The arguments say which partitions and far views the camera sees.
    pub fn new(partitions: &[bool], far_views: &[bool]) -> Self {
        let parts = partitions.iter().chain(far_views);
        Self {
            partitions: partitions.len(),
            parts: parts.map(|is_seen| is_seen.then(SweptPart::default)).collect(),
            plans: VecDeque::new(),
            epoch: None,
            first: None,
            newest: 0,
        }
    }

    /// Starts with the partitions of a pipeline. `None` unless the search mode is gaze: other modes
    /// search from the beginning in each frame.
    ///
    /// # Errors
    /// The configuration names files or a partition that cannot be used.
    pub fn of(resolved: &Resolved) -> anyhow::Result<Option<Self>> {
        if !resolved.pipeline.gazes() {
            return Ok(None);
        }
        let mask = resolved.mask()?;
        let seen = |views: &[View]| -> Vec<bool> {
            views.iter().map(|view| !mask.hides_view(view)).collect()
        };
        let (near, far) = (seen(&resolved.partition_views), seen(&resolved.far_views));
        Ok(Some(Self::new(&near, &far)))
    }

    /// Notes a plan.
    pub fn plan(&mut self, plan_id: u64, views: &[PlannedView]) {
        let parts = views.iter().map(|view| view.partition).collect();
        self.plans.push_back((plan_id, parts));
        if self.plans.len() > PLANS_KEPT {
            self.plans.pop_front();
        }
    }

    /// Notes that a view was searched.
    pub fn searched(&mut self, header: &DetectionHeader) {
        let stamp = &header.stamp;
        let epoch = (stamp.source_generation, stamp.epoch);
        if self.epoch != Some(epoch) {
            self.epoch = Some(epoch);
            (self.first, self.newest) = (None, stamp.sequence);
            self.parts.iter_mut().flatten().for_each(|part| part.last = None);
        }
        let first = *self.first.get_or_insert(stamp.sequence);
        self.newest = self.newest.max(stamp.sequence);
        // A restarted fusion counts its plans from 1 again: take the newest plan of that number.
        let plan = self.plans.iter().rev().find(|(id, _)| *id == header.plan_id);
        let part = plan
            .and_then(|(_, parts)| parts.get(header.view_index as usize))
            .and_then(|&part| self.parts.get_mut(part as usize)?.as_mut())
            .filter(|_| header.failed == 0);
        let Some(part) = part else { return };
        // Records of a frame may come after those of the next frame.
        let Some(gap) = stamp.sequence.checked_sub(part.last.unwrap_or(first)) else { return };
        if part.last.is_some() && gap > 0 {
            (part.sum, part.gaps) = (part.sum.saturating_add(gap), part.gaps + 1);
        }
        part.worst = part.worst.max(gap);
        part.last = Some(stamp.sequence);
    }

    /// The gaps so far. `None` before the first record.
    pub fn report(&self) -> Option<SweepReport> {
        let first = self.first?;
        let (near, far) = self.parts.split_at(self.partitions);
        let gaps = |parts: &[Option<SweptPart>]| {
            let parts: Vec<SweptPart> = parts.iter().copied().flatten().collect();
            let (sum, count) = parts.iter().fold((0u64, 0), |(sum, gaps), part| {
                (sum.saturating_add(part.sum), gaps + part.gaps)
            });
            let open = |part: &SweptPart| self.newest - part.last.unwrap_or(first).min(self.newest);
            SearchGaps {
                views: parts.len(),
                mean_frames: (count > 0).then(|| sum as f64 / count as f64),
                worst_frames: parts
                    .iter()
                    .map(|part| part.worst.max(open(part)))
                    .max()
                    .unwrap_or(0),
            }
        };
        Some(SweepReport {
            frames: (self.newest - first).saturating_add(1),
            partitions: gaps(near),
            far_views: (!far.is_empty()).then(|| gaps(far)),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockeye_contract::FrameStamp;

    fn plan_of(parts: &[u32]) -> Vec<PlannedView> {
        parts.iter().map(|&partition| PlannedView { partition, ..PlannedView::default() }).collect()
    }

    fn search(sweep: &mut Sweep, sequence: u64, plan_id: u64, view_index: u32) {
        let stamp = FrameStamp { sequence, ..FrameStamp::default() };
        sweep.searched(&DetectionHeader {
            stamp,
            plan_id,
            view_index,
            ..DetectionHeader::default()
        });
    }

    #[test]
    fn gaps_are_those_counted_by_hand() {
        // The camera does not see the third partition: it has no gap.
        let mut sweep = Sweep::new(&[true, true, false], &[true]);
        assert_eq!(sweep.report(), None);
        // A neighbour's view first, which is no part; then partition 1, partition 0, the far view.
        sweep.plan(1, &plan_of(&[u32::MAX, 1, 0, 3]));
        for (sequence, views) in [(10, vec![0, 1, 2]), (11, vec![0, 3]), (14, vec![0, 1])] {
            views.into_iter().for_each(|view| search(&mut sweep, sequence, 1, view));
        }
        search(&mut sweep, 16, 1, 1);
        // It comes late, and the part was searched after it: no gap.
        search(&mut sweep, 12, 1, 1);
        let report = sweep.report().expect("there are records");
        assert_eq!(report.frames, 7);
        // Partition 1: 10, 14, 16; partition 0: 10, and not again until 16.
        let near = SearchGaps { views: 2, mean_frames: Some(3.0), worst_frames: 6 };
        assert_eq!(report.partitions, near);
        let far = SearchGaps { views: 1, mean_frames: None, worst_frames: 5 };
        assert_eq!(report.far_views, Some(far));
        assert_eq!(
            report.to_string(),
            "each partition every 3.0 frames (6 at most), each far view every - frames (5 at most)"
        );
    }

    #[test]
    fn the_wait_for_the_first_search_counts_as_a_gap() {
        let mut sweep = Sweep::new(&[true, true], &[]);
        sweep.plan(1, &plan_of(&[0, 1]));
        for (sequence, view) in [(20, 0), (21, 0), (27, 1), (28, 1), (28, 0)] {
            search(&mut sweep, sequence, 1, view);
        }
        let report = sweep.report().expect("there are records");
        assert_eq!(report.partitions.worst_frames, 7);
        assert_eq!(
            report.partitions.mean_frames,
            Some(3.0),
            "the first wait has no beginning, so the mean leaves it out"
        );
    }

    #[test]
    fn unknown_plans_and_failed_searches_are_ignored() {
        let mut sweep = Sweep::new(&[true], &[]);
        sweep.plan(1, &plan_of(&[0]));
        search(&mut sweep, 5, 1, 0);
        search(&mut sweep, 9, 7, 0);
        search(&mut sweep, 9, 1, 3);
        let failed = DetectionHeader {
            stamp: FrameStamp { sequence: 9, ..FrameStamp::default() },
            plan_id: 1,
            failed: 1,
            ..DetectionHeader::default()
        };
        sweep.searched(&failed);
        let report = sweep.report().expect("there are records");
        assert_eq!((report.partitions.mean_frames, report.partitions.worst_frames), (None, 4));
        // The source restarts: frame numbers begin again.
        let stamp = FrameStamp { epoch: 1, ..FrameStamp::default() };
        sweep.searched(&DetectionHeader { stamp, plan_id: 1, ..DetectionHeader::default() });
        assert_eq!(sweep.report().expect("a record").partitions.worst_frames, 0);
    }
}
