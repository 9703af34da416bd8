//! How much of a frame may be cut: by the time in flight, by stated costs in a lossless run.

use flockeye_config::{FrameLimit, Pipeline};
use flockeye_contract::{FrameStamp, PlannedView, StageName, StopReason};

use flockeye_geometry::search::MAX_FRAMES_WITHOUT_TILE;

use crate::cadence::Cadence;
use crate::job::Upcoming;
use crate::virtual_budget::VirtualBudget;

/// What decides how many tiles of a frame are cut.
#[derive(Debug, Clone)]
pub(crate) enum Clock {
    /// The time, in flight.
    Live(Cadence),
    /// Stated costs, in a lossless run that does what flight does.
    Virtual(VirtualBudget),
    /// The plan's own budget of views.
    Unlimited,
}

/// Decides whether there is time for one more tile.
#[derive(Debug, Clone)]
pub(crate) struct FrameClock {
    /// What it goes by.
    pub(crate) clock: Clock,
    frames_without_tile: u64,
}

impl FrameClock {
    /// The clock that a configuration asks for.
    pub(crate) fn of(pipeline: &Pipeline) -> Self {
        Self::new(match pipeline.limit() {
            FrameLimit::Time => Clock::Live(Cadence::default()),
            FrameLimit::Costs => {
                let has_egomotion = pipeline.runs(StageName::Egomotion);
                Clock::Virtual(VirtualBudget::new(pipeline.costs(), has_egomotion))
            }
            FrameLimit::Unlimited => Clock::Unlimited,
        })
    }

    /// Goes by `clock`.
    pub(crate) fn new(clock: Clock) -> Self {
        Self { clock, frames_without_tile: 0 }
    }

    /// Whether a plan's own budget of views counts.
    pub(crate) fn is_unlimited(&self) -> bool {
        matches!(self.clock, Clock::Unlimited)
    }

    /// A frame came at `now_ns`.
    pub(crate) fn note_arrival(&mut self, stamp: &FrameStamp, now_ns: i64) {
        if let Clock::Live(cadence) = &mut self.clock {
            cadence.note(stamp, now_ns);
        }
    }

    /// A frame is taken up.
    pub(crate) fn begin_frame(&mut self, stamp: &FrameStamp) {
        if let Clock::Virtual(budget) = &mut self.clock {
            budget.begin_frame(stamp);
        }
    }

    /// The picture was looked at for places like a body, which took `took_ns`.
    pub(crate) fn note_look(&mut self, took_ns: i64) {
        match &mut self.clock {
            Clock::Live(cadence) => cadence.note_look(took_ns),
            Clock::Virtual(budget) => budget.spend_look(),
            Clock::Unlimited => {}
        }
    }

    /// A view was cut, which took `took_ns`.
    pub(crate) fn note_cut(&mut self, planned: &PlannedView, took_ns: i64) {
        match &mut self.clock {
            Clock::Live(cadence) if planned.is_tile() => cadence.note_cut(took_ns),
            Clock::Virtual(budget) => budget.spend(planned),
            Clock::Live(_) | Clock::Unlimited => {}
        }
    }

    /// A tile was searched for `took_ns`, as its worker reports.
    pub(crate) fn note_search(&mut self, took_ns: i64) {
        if let Clock::Live(cadence) = &mut self.clock {
            cadence.note_search(took_ns);
        }
    }

    /// The views of a frame have ended; `tiles` of its tiles were cut.
    pub(crate) fn end_frame(&mut self, tiles: usize) {
        self.frames_without_tile = match tiles {
            0 => self.frames_without_tile.saturating_add(1),
            _ => 0,
        };
    }

    /// Why there is no time for the view `next`: a newer frame waits or is due, or the frame's
    /// budget is spent. `None` where there is. A frame that has come to no tile yet, as those
    /// before it, has time for one, and for nothing else: the plan has a tile before its proposals
    /// then.
    pub(crate) fn why_over(
        &self,
        next: Option<Upcoming<'_>>,
        tiles: usize,
        is_newer_waiting: bool,
        now_ns: i64,
    ) -> Option<StopReason> {
        let is_tile = next.is_some_and(|next| next.view.is_tile());
        if is_tile && tiles == 0 && self.frames_without_tile >= MAX_FRAMES_WITHOUT_TILE {
            return None;
        }
        match &self.clock {
            Clock::Live(cadence) => {
                let needs_look = next.is_some_and(|next| next.needs_look);
                let has_time = cadence.has_time_to_cut(needs_look, now_ns);
                (is_newer_waiting || !has_time).then_some(StopReason::Newer)
            }
            Clock::Virtual(budget) => {
                next.is_some_and(|next| !budget.fits(next)).then_some(StopReason::Budget)
            }
            Clock::Unlimited => None,
        }
    }

    /// Whether another tile may be on its way to `workers`, which have not answered `outstanding`
    /// views.
    ///
    /// In flight one worker stays free of tiles, because they would delay the next frame's regions
    /// of interest. A single worker gets one tile at a time. One more is cut ahead while it and the
    /// one before will have been searched before the next frame is due.
    pub(crate) fn has_room_for_tile(
        &self,
        outstanding: usize,
        workers: usize,
        now_ns: i64,
    ) -> bool {
        let Clock::Live(cadence) = &self.clock else { return true };
        let is_ahead = cadence.has_time_to_cut_ahead(now_ns);
        outstanding < workers.saturating_sub(1).max(1) + usize::from(is_ahead)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockeye_config::Profile;
    use flockeye_contract::ViewKind;

    const MS: i64 = 1_000_000;

    fn tile() -> PlannedView {
        PlannedView { kind: ViewKind::Partition.code(), ..PlannedView::default() }
    }

    fn upcoming(view: &PlannedView) -> Option<Upcoming<'_>> {
        Some(Upcoming { view, needs_look: view.is_proposal() })
    }

    #[test]
    fn after_some_frames_for_regions_only_a_tile_is_due() {
        let mut clock = FrameClock::new(Clock::Live(Cadence::default()));
        (0..4).for_each(|_| {
            assert_eq!(clock.why_over(upcoming(&tile()), 0, true, 0), Some(StopReason::Newer));
            clock.end_frame(0);
        });
        assert_eq!(clock.why_over(upcoming(&tile()), 0, true, 0), None, "a tile is due");
        let proposal = PlannedView { kind: ViewKind::Proposal.code(), ..PlannedView::default() };
        let newer = Some(StopReason::Newer);
        assert_eq!(clock.why_over(upcoming(&proposal), 0, true, 0), newer, "and nothing else is");
        assert!(clock.why_over(upcoming(&tile()), 1, true, 0).is_some(), "one is enough");
        clock.end_frame(0);
        assert_eq!(clock.why_over(upcoming(&tile()), 0, true, 0), None);
        clock.end_frame(1);
        assert_eq!(clock.why_over(upcoming(&tile()), 0, true, 0), Some(StopReason::Newer));
    }

    #[test]
    fn one_worker_stays_free_of_tiles_unless_they_are_searched_in_time() {
        let mut cadence = Cadence::default();
        for (sequence, at_ms) in [(0, 100), (1, 130)] {
            let stamp = FrameStamp { sequence, exposure_ns: at_ms * MS, ..FrameStamp::default() };
            cadence.note(&stamp, at_ms * MS);
        }
        let unknown = FrameClock::new(Clock::Live(cadence.clone()));
        assert!(unknown.has_room_for_tile(0, 1, 0) && !unknown.has_room_for_tile(1, 2, 0));
        assert!(unknown.has_room_for_tile(1, 3, 0));
        cadence.note_search(5 * MS);
        let quick = FrameClock::new(Clock::Live(cadence));
        assert!(quick.has_room_for_tile(1, 2, 140 * MS));
        assert!(!quick.has_room_for_tile(1, 2, 155 * MS));
        assert!(FrameClock::new(Clock::Unlimited).has_room_for_tile(9, 1, 0));
    }

    #[test]
    fn a_configuration_chooses_the_clock() {
        let of = |profile| FrameClock::of(&Pipeline { profile, ..Pipeline::default() }).clock;
        assert!(matches!(of(Profile::Flight), Clock::Live(_)));
        assert!(matches!(of(Profile::Repeat), Clock::Virtual(_)));
        assert!(matches!(of(Profile::Stills), Clock::Virtual(_)));
        assert!(matches!(of(Profile::Unlimited), Clock::Unlimited));
    }
}
