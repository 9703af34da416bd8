//! Time budget of a frame by configured costs: a lossless run cuts the same views as flight, and is
//! reproducible.

use flockeye_config::Costs;
use flockeye_contract::{FrameStamp, PlannedView, Search};

/// Interval assumed before the second frame: 30 frames/s.
const FIRST_INTERVAL_NS: i64 = 33_333_333;

/// Maximum interval: a slower source does not increase the budget of a frame.
const MAX_INTERVAL_NS: i64 = 1_000_000_000;

/// Number of threshold windows for a proposal, as in detection. Regions of interest, of which there
/// are few, are charged alike, though they have more.
pub const PROPOSAL_WINDOWS: f64 = 2.0;

/// Remaining processor time of a frame, by the configured costs.
///
/// The budget is the interval to the frame before, on each processor. Source, regions of interest
/// and fusion are subtracted first; tiles use the rest. An overrun is subtracted from the next
/// frame's budget.
#[derive(Debug, Clone)]
pub(crate) struct VirtualBudget {
    costs: Costs,
    /// Cost of each frame before its views, ms.
    each_frame_ms: f64,
    last: Option<FrameStamp>,
    left_ms: f64,
}

impl VirtualBudget {
    /// A budget with these costs, before the first frame. `has_egomotion`: whether the egomotion
    /// stage runs.
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
        // Limit of the overrun: flight drops frames when it is a whole frame late.
        let overdrawn_ms = self.left_ms.clamp(-whole_ms, 0.0);
        self.left_ms = whole_ms + overdrawn_ms - self.each_frame_ms;
    }

    /// Whether a view fits into the remaining budget, with a proposal search if needed.
    pub(crate) fn fits(&self, planned: &PlannedView, needs_look: bool) -> bool {
        let look_ms = if needs_look { self.costs.proposals_ms } else { 0.0 };
        look_ms + self.cost_ms(planned) <= self.left_ms
    }

    pub(crate) fn spend(&mut self, planned: &PlannedView) {
        self.left_ms -= self.cost_ms(planned);
    }

    /// Subtracts the cost of a proposal search.
    pub(crate) fn spend_look(&mut self) {
        self.left_ms -= self.costs.proposals_ms;
    }

    /// Cost of a view from its cut to its poses, ms.
    fn cost_ms(&self, planned: &PlannedView) -> f64 {
        let costs = &self.costs;
        let windows = match Search::try_from(planned.search) {
            Ok(Search::Nothing) => 0.0,
            Ok(Search::FineWindow | Search::CoarseWindow) => 1.0,
            Ok(Search::AllWindows) | Err(_) => PROPOSAL_WINDOWS,
        };
        // Cutting and searching have a cost proportional to the pixels.
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

    /// Spends tiles while they fit, each searched with one window. Returns their number.
    fn tiles(budget: &mut VirtualBudget) -> usize {
        let tile = planned(ViewKind::Partition, Search::FineWindow);
        let mut spends = || budget.fits(&tile, false).then(|| budget.spend(&tile)).is_some();
        (0..).take_while(|_| spends()).count()
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
    fn proposals_cost_their_search_for_places_and_two_windows() {
        let mut budget = VirtualBudget::new(Costs { proposals_ms: 4.7, ..costs() }, false);
        budget.begin_frame(&stamp(0, 0));
        budget.spend_look();
        let proposal =
            PlannedView { size_px: 500, ..planned(ViewKind::Proposal, Search::AllWindows) };
        (0..2).for_each(|_| budget.spend(&proposal));
        let proposal_fits =
            |budget: &VirtualBudget, needs_look: bool| budget.fits(&proposal, needs_look);
        assert_eq!(tiles(&mut budget), 4, "56.7 - 4.7 - 2 * 0.25 * 18 = 43 ms");
        budget.begin_frame(&stamp(1, 8));
        // 16 - 10 ms are left: 4.5 for a proposal, or 9.2 with the look.
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
