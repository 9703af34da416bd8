//! Which views of a frame fit into its time by stated costs, so that a lossless run cuts what
//! flight cuts and still gives the same bytes each time.

use flockeye_config::Costs;
use flockeye_contract::{FrameStamp, PlannedView, Search};

use crate::job::Upcoming;

/// The interval until two frames have shown it: that of the usual source, 30 frames/s.
const FIRST_INTERVAL_NS: i64 = 33_333_333;

/// A source that is slower than this leaves no more time for a frame.
const MAX_INTERVAL_NS: i64 = 1_000_000_000;

/// Threshold windows that a proposal is searched with: as many as detection has for it.
pub const PROPOSAL_WINDOWS: f64 = 5.0;

/// Processor time that is left of a frame, by the stated costs of the configuration.
///
/// A frame has the interval to the frame before, on each processor. Its source, its regions of
/// interest and what fusion does with them come first; tiles get what is left. A frame that takes
/// longer than it has takes the rest from the next one.
#[derive(Debug, Clone)]
pub(crate) struct VirtualBudget {
    costs: Costs,
    /// What each frame takes before its views.
    each_frame_ms: f64,
    last: Option<FrameStamp>,
    left_ms: f64,
}

impl VirtualBudget {
    /// A budget with these costs, before the first frame. `has_egomotion`: whether the camera's
    /// rotation is measured.
    pub(crate) fn new(costs: Costs, has_egomotion: bool) -> Self {
        let egomotion_ms = if has_egomotion { costs.egomotion_ms } else { 0.0 };
        let each_frame_ms = costs.source_ms + egomotion_ms;
        Self { costs, each_frame_ms, last: None, left_ms: 0.0 }
    }

    pub(crate) fn begin_frame(&mut self, stamp: &FrameStamp) {
        let interval_ns = self.last.and_then(|last| stamp.interval_ns(&last));
        let interval_ns = interval_ns.unwrap_or(FIRST_INTERVAL_NS).min(MAX_INTERVAL_NS);
        self.last = Some(*stamp);
        let whole_ms = interval_ns as f64 * 1e-6 * self.costs.processors;
        // Flight skips frames when it is a whole frame late.
        let overdrawn_ms = self.left_ms.clamp(-whole_ms, 0.0);
        self.left_ms = whole_ms + overdrawn_ms - self.each_frame_ms;
    }

    /// Whether a view fits into what is left, with the look for places that it may need.
    pub(crate) fn fits(&self, next: Upcoming<'_>) -> bool {
        let look_ms = if next.needs_look { self.costs.proposals_ms } else { 0.0 };
        look_ms + self.cost_ms(next.view) <= self.left_ms
    }

    pub(crate) fn spend(&mut self, planned: &PlannedView) {
        self.left_ms -= self.cost_ms(planned);
    }

    /// The picture was looked at for places like a body.
    pub(crate) fn spend_look(&mut self) {
        self.left_ms -= self.costs.proposals_ms;
    }

    /// What a view costs from its cut to its poses.
    fn cost_ms(&self, planned: &PlannedView) -> f64 {
        let costs = &self.costs;
        let all_windows = if planned.is_proposal() { PROPOSAL_WINDOWS } else { 2.0 };
        let windows = match Search::try_from(planned.search) {
            Ok(Search::Nothing) => 0.0,
            Ok(Search::FineWindow | Search::CoarseWindow) => 1.0,
            Ok(Search::AllWindows) | Err(_) => all_windows,
        };
        // Cutting and searching take about the same time for each pixel.
        let megapixels = f64::from(planned.size_px).powi(2) * 1e-6;
        let is_region = !planned.is_tile() && !planned.is_proposal();
        let direct_pass_ms = if is_region { costs.direct_pass_ms } else { 0.0 };
        megapixels * (costs.cut_ms_per_megapixel + windows * costs.window_ms_per_megapixel)
            + direct_pass_ms
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockeye_contract::ViewKind;

    fn costs() -> Costs {
        Costs {
            processors: 2.0,
            source_ms: 10.0,
            direct_pass_ms: 3.0,
            cut_ms_per_megapixel: 2.0,
            window_ms_per_megapixel: 8.0,
            ..Costs::default()
        }
    }

    fn planned(kind: ViewKind, search: Search) -> PlannedView {
        PlannedView {
            kind: kind.code(),
            search: search.code(),
            size_px: 1000,
            ..PlannedView::default()
        }
    }

    fn stamp(sequence: u64, at_ms: i64) -> FrameStamp {
        FrameStamp { sequence, exposure_ns: at_ms * 1_000_000, ..FrameStamp::default() }
    }

    /// How many tiles, each searched with one window, fit into what is left. They are spent.
    fn tiles(budget: &mut VirtualBudget) -> usize {
        let tile = planned(ViewKind::Partition, Search::FineWindow);
        let next = Upcoming { view: &tile, needs_look: false };
        (0..).take_while(|_| budget.fits(next).then(|| budget.spend(&tile)).is_some()).count()
    }

    #[test]
    fn tiles_get_what_source_and_regions_leave() {
        let mut budget = VirtualBudget::new(costs(), false);
        budget.begin_frame(&stamp(0, 0));
        assert_eq!(tiles(&mut budget), 5, "2 * 33.3 - 10 = 56.7 ms, a tile takes 10");
        budget.begin_frame(&stamp(1, 50));
        assert_eq!(tiles(&mut budget), 9, "2 * 50 - 10 = 90 ms");
        budget.begin_frame(&stamp(3, 150));
        budget.spend(&planned(ViewKind::Roi, Search::Nothing));
        budget.spend(&planned(ViewKind::Roi, Search::AllWindows));
        assert_eq!(tiles(&mut budget), 6, "90 - 5 - 21 = 64 ms");
        let both = planned(ViewKind::HighResolution, Search::AllWindows);
        budget.begin_frame(&stamp(4, 200));
        budget.spend(&both);
        assert_eq!(tiles(&mut budget), 7, "90 - 18 = 72 ms");
    }

    #[test]
    fn proposals_cost_their_search_for_places_and_five_windows() {
        let mut budget = VirtualBudget::new(Costs { proposals_ms: 4.7, ..costs() }, false);
        budget.begin_frame(&stamp(0, 0));
        budget.spend_look();
        let proposal =
            PlannedView { size_px: 500, ..planned(ViewKind::Proposal, Search::AllWindows) };
        (0..2).for_each(|_| budget.spend(&proposal));
        let proposal_fits = |budget: &VirtualBudget, needs_look: bool| {
            budget.fits(Upcoming { view: &proposal, needs_look })
        };
        assert_eq!(tiles(&mut budget), 3, "56.7 - 4.7 - 2 * 0.25 * 42 = 31 ms");
        budget.begin_frame(&stamp(1, 11));
        // 22 - 10 ms are left: 10.5 for a proposal, or 15.2 with the look.
        assert!(proposal_fits(&budget, false) && !proposal_fits(&budget, true));
    }

    #[test]
    fn a_frame_that_takes_longer_takes_it_from_the_next() {
        let mut budget = VirtualBudget::new(costs(), false);
        budget.begin_frame(&stamp(0, 0));
        let region = planned(ViewKind::Roi, Search::AllWindows);
        (0..4).for_each(|_| budget.spend(&region));
        assert_eq!(tiles(&mut budget), 0, "56.7 - 84 = -27.3 ms");
        budget.begin_frame(&stamp(1, 50));
        assert_eq!(tiles(&mut budget), 6, "90 - 27.3 = 62.7 ms");
        // What is more than a whole frame is lost.
        (0..99).for_each(|_| budget.spend(&region));
        budget.begin_frame(&stamp(2, 100));
        assert_eq!(tiles(&mut budget), 0, "100 - 100 - 10 = -10 ms");
        budget.begin_frame(&stamp(3, 150));
        assert_eq!(tiles(&mut budget), 8, "90 - 10 = 80 ms");
    }
}
