//! Views of one frame: their order, their state, and the end of the frame.

use std::collections::BTreeSet;

use flockeye_contract::{FrameHeader, NONE, PlannedView, Search, StopReason, StopRule, ViewKind};
use flockeye_convert::{at_exposure, xyzw};
use flockeye_geometry::view::View;

/// The views of a frame, and their state.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct FrameJob {
    pub(crate) frame: FrameHeader,
    /// Id of the plan; 0: this stage's own sweep.
    pub(crate) plan_id: u64,
    /// Start of the work on the frame, CLOCK_MONOTONIC, nanoseconds.
    pub(crate) taken_ns: i64,
    views: Vec<PlannedView>,
    stop_rule: StopRule,
    budget: usize,
    issued: usize,
    unanswered: BTreeSet<u32>,
    recut: BTreeSet<u32>,
    has_hit: bool,
    /// Whether a cut has failed: no other view is tried.
    pub(crate) has_failed: bool,
    ended: Option<StopReason>,
    /// Whether the proposals have their places from the proposal search.
    are_proposals_placed: bool,
}

/// Number of tiles cut ahead, in addition to the tiles cut in the frame before.
const SPARE_TILES: usize = 2;

/// Next step of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum NextView {
    Cut {
        /// Index of the view in the plan.
        index: u32,
        /// Whether a newer frame has priority over it: it must not delay the next frame's views.
        is_yielding: bool,
    },
    /// Publish the frame's end, for this reason.
    End(StopReason),
    /// Wait for the answers to the views of an ended frame.
    Wait,
}

impl FrameJob {
    /// A job with the plan's `views` and stop rule. `budget` limits the number of views in a
    /// lossless run.
    pub(crate) fn new(
        frame: FrameHeader,
        plan_id: u64,
        views: Vec<PlannedView>,
        stop_rule: StopRule,
        budget: usize,
        taken_ns: i64,
    ) -> Self {
        Self {
            frame,
            plan_id,
            taken_ns,
            views,
            stop_rule,
            budget,
            issued: 0,
            unanswered: BTreeSet::new(),
            recut: BTreeSet::new(),
            has_hit: false,
            has_failed: false,
            ended: None,
            are_proposals_placed: false,
        }
    }

    /// The next step. `why_over` is the reason why no time remains for another view, if so.
    pub(crate) fn next(&self, why_over: Option<StopReason>) -> NextView {
        if self.has_failed {
            return NextView::End(StopReason::Failed);
        }
        if let Some(&index) = self.recut.first() {
            return NextView::Cut { index, is_yielding: false };
        }
        if self.ended.is_some() {
            return NextView::Wait;
        }
        if self.has_hit && self.stop_rule == StopRule::FirstHit {
            return NextView::End(StopReason::Hit);
        }
        let Some(view) = self.views.get(self.issued) else {
            return NextView::End(StopReason::Complete);
        };
        if self.stop_rule != StopRule::Deadline {
            return NextView::Cut { index: self.issued as u32, is_yielding: false };
        }
        if self.issued >= self.budget {
            return NextView::End(StopReason::Budget);
        }
        // Views of neighbours, and all views before them, are always cut. The frame's first view is
        // always cut too, so that frames under overload have at least one view.
        let is_yielding =
            may_yield(view) && self.issued > 0 && self.views[self.issued..].iter().all(may_yield);
        if let Some(reason) = why_over.filter(|_| is_yielding) {
            return NextView::End(reason);
        }
        NextView::Cut { index: self.issued as u32, is_yielding }
    }

    /// Views that will probably be cut: all views of neighbours, and `searched` + [`SPARE_TILES`]
    /// tiles. `searched` is the number of tiles cut in the frame before. Proposals are included
    /// once they have places.
    pub(crate) fn likely(&self, searched: usize) -> Vec<u32> {
        let mut tiles = match self.stop_rule {
            StopRule::All => usize::MAX,
            StopRule::FirstHit | StopRule::Deadline => searched + SPARE_TILES,
        };
        let mut is_likely = |view: &PlannedView| {
            let has_place = !view.is_proposal() || self.are_proposals_placed;
            let fits = has_place && (!view.is_tile() || tiles > 0);
            tiles = tiles.saturating_sub(usize::from(view.is_tile()));
            fits
        };
        self.from(0).filter(|&index| is_likely(&self.views[index as usize])).collect()
    }

    /// Indices of the views from `index` on within the stop rule and the budget.
    pub(crate) fn from(&self, index: u32) -> impl Iterator<Item = u32> {
        let end = match self.stop_rule {
            StopRule::Deadline => self.views.len().min(self.budget),
            StopRule::FirstHit | StopRule::All => self.views.len(),
        };
        index..end as u32
    }

    /// Number of published tiles.
    pub(crate) fn searched(&self) -> usize {
        let views = self.views.iter().take(self.issued);
        views.filter(|view| view.is_tile()).count()
    }

    /// A view, rotated to the frame's exposure, and its entry in the plan.
    pub(crate) fn view(&self, index: u32) -> Option<(View, PlannedView)> {
        let planned = self.views.get(index as usize)?;
        Some((at_exposure(planned, self.frame.stamp.exposure_ns), *planned))
    }

    /// Whether the proposals have no places yet.
    pub(crate) fn awaits_places(&self) -> bool {
        !self.are_proposals_placed
    }

    pub(crate) fn proposal_indices(&self) -> Vec<u32> {
        let views = (0..).zip(&self.views);
        views.filter(|(_, view)| view.is_proposal()).map(|(index, _)| index).collect()
    }

    /// Number of a view among the plan's proposals, from 0. `None` for other views.
    pub(crate) fn proposal(&self, index: u32) -> Option<usize> {
        let (before, rest) = self.views.split_at_checked(index as usize)?;
        let place = before.iter().filter(|view| view.is_proposal()).count();
        rest.first()?.is_proposal().then_some(place)
    }

    /// Assigns places to the plan's proposals, in this order. Further proposals stay empty.
    pub(crate) fn place_proposals(&mut self, places: impl IntoIterator<Item = View>) {
        self.are_proposals_placed = true;
        let slots = self.views.iter_mut().filter(|view| view.is_proposal());
        for (slot, view) in slots.zip(places) {
            slot.camera_from_view = xyzw(&view.camera_from_view);
            (slot.focal_px, slot.size_px) = (view.focal_px, view.size_px);
            slot.search = Search::AllWindows.code();
        }
    }

    /// Whether the view is a tile of either resolution.
    pub(crate) fn is_tile(&self, index: u32) -> bool {
        self.views.get(index as usize).is_some_and(PlannedView::is_tile)
    }

    pub(crate) fn note_issued(&mut self, index: u32) {
        if !self.recut.remove(&index) {
            self.issued = self.issued.max(index as usize + 1);
        }
        self.unanswered.insert(index);
    }

    /// Notes an answer; `is_hit`: a marker of a configured body was found in the view.
    pub(crate) fn note_answer(&mut self, index: u32, is_hit: bool) {
        self.has_hit |= is_hit;
        self.unanswered.remove(&index);
        self.recut.remove(&index);
    }

    /// Schedules a view for a repeated cut, after its worker's timeout.
    pub(crate) fn take_back(&mut self, index: u32) {
        if self.unanswered.remove(&index) {
            self.recut.insert(index);
        }
    }

    /// The next view in the plan's order, and whether it needs a proposal search before.
    pub(crate) fn upcoming(&self) -> Option<(&PlannedView, bool)> {
        let view = self.views.get(self.issued)?;
        Some((view, view.is_proposal() && self.awaits_places()))
    }

    pub(crate) fn note_end(&mut self, reason: StopReason) {
        self.has_failed = false;
        self.ended = Some(reason);
    }

    /// Whether the frame has ended and all its answers have arrived.
    pub(crate) fn is_done(&self) -> bool {
        self.ended.is_some() && self.unanswered.is_empty() && self.recut.is_empty()
    }

    pub(crate) fn has_ended(&self) -> bool {
        self.ended.is_some()
    }

    /// Number of published views, and of the plan's other views.
    pub(crate) fn tally(&self) -> (u32, u32) {
        (self.issued as u32, (self.views.len() - self.issued) as u32)
    }
}

/// Whether a newer frame has priority over a view.
fn may_yield(view: &PlannedView) -> bool {
    view.is_tile() || view.is_proposal()
}

/// The views of a frame without a plan: all tiles, from number `first` on.
pub(crate) fn sweep(tiles: &[(u32, View)], first: usize) -> Vec<PlannedView> {
    let count = tiles.len();
    (0..count)
        .map(|k| tiles[(first + k) % count])
        .map(|(tile, view)| PlannedView {
            camera_from_view: xyzw(&view.camera_from_view),
            focal_px: view.focal_px,
            size_px: view.size_px,
            kind: ViewKind::Partition.code(),
            tile,
            target: NONE,
            search: Search::AllWindows.code(),
            ..PlannedView::default()
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockeye_geometry::partition::Partition;
    use nalgebra::Vector3;

    fn planned(kind: ViewKind) -> PlannedView {
        PlannedView {
            camera_from_view: [0.0, 0.0, 0.0, 1.0],
            focal_px: 100.0,
            size_px: 64,
            kind: kind.code(),
            ..PlannedView::default()
        }
    }

    fn job(stop_rule: StopRule, kinds: &[ViewKind], budget: usize) -> FrameJob {
        let views = kinds.iter().map(|&kind| planned(kind)).collect();
        FrameJob::new(FrameHeader::default(), 1, views, stop_rule, budget, 0)
    }

    /// Cuts views until the frame ends; every view is answered at once, view `hit` with a marker.
    fn run(job: &mut FrameJob, hit: Option<u32>, newer_from: u32) -> (u32, StopReason) {
        let mut cut = 0;
        loop {
            match job.next((cut >= newer_from).then_some(StopReason::Newer)) {
                NextView::Cut { index, .. } => {
                    assert_eq!(index, cut);
                    job.note_issued(index);
                    job.note_answer(index, hit == Some(index));
                    cut += 1;
                }
                NextView::End(reason) => {
                    job.note_end(reason);
                    assert!(job.is_done());
                    return (cut, reason);
                }
                NextView::Wait => panic!("nothing to wait for"),
            }
        }
    }

    use ViewKind::{HighResolution, Partition as Part, Roi};

    #[test]
    fn the_paper_stops_at_the_first_hit() {
        let mut searched = job(StopRule::FirstHit, &[Part; 12], usize::MAX);
        assert_eq!(run(&mut searched, Some(4), 0), (5, StopReason::Hit));
        let mut searched = job(StopRule::FirstHit, &[Part; 12], usize::MAX);
        assert_eq!(run(&mut searched, None, 0), (12, StopReason::Complete));
    }

    #[test]
    fn all_means_all_even_if_a_newer_frame_waits() {
        let mut searched = job(StopRule::All, &[Part; 12], 3);
        assert_eq!(run(&mut searched, Some(0), 0), (12, StopReason::Complete));
    }

    #[test]
    fn a_newer_frame_pushes_out_tiles_only() {
        let mut searched = job(StopRule::Deadline, &[Roi, Roi, Part, Part, Part], usize::MAX);
        assert_eq!(run(&mut searched, None, 0), (2, StopReason::Newer));
        let mut searched = job(StopRule::Deadline, &[Part; 5], usize::MAX);
        assert_eq!(run(&mut searched, None, 0), (1, StopReason::Newer), "one is always searched");
        let mut searched = job(StopRule::Deadline, &[Roi, Part, Roi, Part, Part], usize::MAX);
        assert_eq!(run(&mut searched, None, 0), (3, StopReason::Newer), "no neighbour is left out");
        let mut searched = job(StopRule::Deadline, &[Part; 5], 3);
        assert_eq!(run(&mut searched, None, u32::MAX), (3, StopReason::Budget));
        let mut searched = job(StopRule::Deadline, &[Roi, HighResolution, Part], usize::MAX);
        assert_eq!(
            run(&mut searched, None, 0),
            (1, StopReason::Newer),
            "tiles of both resolutions"
        );
    }

    #[test]
    fn proposals_get_their_places_in_order_and_give_way_to_a_newer_frame() {
        use ViewKind::Proposal;
        let mut searched = job(StopRule::Deadline, &[Roi, Proposal, Proposal, Part], usize::MAX);
        assert_eq!(searched.proposal_indices(), [1, 2]);
        assert!(searched.awaits_places());
        assert_eq!(searched.likely(0), [0, 3], "what has no place cannot be cut ahead");
        let place = View::looking_at(&Vector3::y_axis(), 0.1, 99);
        searched.place_proposals([place]);
        assert!(!searched.awaits_places());
        let (view, planned) = searched.view(1).expect("it is in the plan");
        assert!(view.direction_in_camera().angle(&Vector3::y_axis()) < 1e-9);
        assert_eq!((view.size_px, planned.search), (99, Search::AllWindows.code()));
        assert_eq!(searched.view(2).expect("it is in the plan").0.size_px, 64, "nothing was found");
        let places: Vec<_> = (0..5).map(|index| searched.proposal(index)).collect();
        assert_eq!(places, [None, Some(0), Some(1), None, None]);
        assert_eq!(searched.likely(0).len(), 4, "a spare tile is among them");
        assert_eq!(run(&mut searched, None, 0), (1, StopReason::Newer));
    }

    #[test]
    fn a_view_taken_back_is_cut_again_and_waited_for() {
        let mut searched = job(StopRule::All, &[Part; 2], usize::MAX);
        searched.note_issued(0);
        searched.note_issued(1);
        searched.note_end(StopReason::Complete);
        searched.note_answer(1, false);
        searched.take_back(1);
        assert_eq!(
            searched.next(Some(StopReason::Newer)),
            NextView::Wait,
            "an answered view is not taken back"
        );
        searched.take_back(0);
        assert_eq!(
            searched.next(Some(StopReason::Newer)),
            NextView::Cut { index: 0, is_yielding: false }
        );
        searched.note_issued(0);
        assert!(!searched.is_done());
        searched.note_answer(0, false);
        assert!(searched.is_done());
        assert_eq!(searched.tally(), (2, 0));
    }

    #[test]
    fn all_neighbours_and_as_many_tiles_as_before_and_some_are_likely() {
        let kinds = [Roi, Part, Part, Part, Roi, Part, Part];
        let of = |rule, budget, searched| job(rule, &kinds, budget).likely(searched);
        assert_eq!(of(StopRule::Deadline, usize::MAX, 0), [0, 1, 2, 4]);
        assert_eq!(of(StopRule::Deadline, usize::MAX, 2), [0, 1, 2, 3, 4, 5]);
        assert_eq!(of(StopRule::Deadline, 3, 2), [0, 1, 2]);
        assert_eq!(of(StopRule::FirstHit, 3, 0), [0, 1, 2, 4]);
        assert_eq!(of(StopRule::All, 3, 0), [0, 1, 2, 3, 4, 5, 6]);
        let mut searched = job(StopRule::Deadline, &kinds, usize::MAX);
        searched.note_issued(2);
        assert_eq!((searched.searched(), searched.from(5).collect()), (2, vec![5, 6]));
    }

    #[test]
    fn a_sweep_goes_on_where_the_last_one_stopped() {
        let views = Partition::icosahedron().views(0.1, 600.0).expect("fits");
        let tiles: Vec<_> = (0..).zip(views).collect();
        let order: Vec<_> = sweep(&tiles, 10).iter().map(|view| view.tile).collect();
        assert_eq!(order, [10, 11, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9]);
    }
}
