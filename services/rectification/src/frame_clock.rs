//! Time budget of a frame: real time in flight, configured costs in a lossless run.

use flockeye_config::{FrameLimit, Pipeline};
use flockeye_contract::{FrameStamp, PlannedView, StageName, StopReason};

use crate::cadence::Cadence;
use crate::virtual_budget::VirtualBudget;

/// Source of the decision whether time remains for a further view of a frame.
#[derive(Debug, Clone)]
pub(crate) enum FrameClock {
    /// Real time, in flight.
    Live(Cadence),
    /// Configured costs, in a lossless run that behaves like flight.
    Virtual(VirtualBudget),
    /// The plan's view budget.
    Unlimited,
}

impl FrameClock {
    /// The clock for a configuration.
    pub(crate) fn of(pipeline: &Pipeline) -> Self {
        match pipeline.limit() {
            FrameLimit::Time => Self::Live(Cadence::default()),
            FrameLimit::Costs => {
                let has_egomotion = pipeline.runs(StageName::Egomotion);
                Self::Virtual(VirtualBudget::new(pipeline.costs(), has_egomotion))
            }
            FrameLimit::Unlimited => Self::Unlimited,
        }
    }

    /// Whether the plan's view budget applies.
    pub(crate) fn is_unlimited(&self) -> bool {
        matches!(self, Self::Unlimited)
    }

    /// Notes a frame that arrived at `now_ns`.
    pub(crate) fn note_arrival(&mut self, stamp: &FrameStamp, now_ns: i64) {
        if let Self::Live(cadence) = self {
            cadence.note(stamp, now_ns);
        }
    }

    /// Notes that a frame becomes active.
    pub(crate) fn begin_frame(&mut self, stamp: &FrameStamp) {
        if let Self::Virtual(budget) = self {
            budget.begin_frame(stamp);
        }
    }

    /// Notes a proposal search in the frame and its duration.
    pub(crate) fn note_look(&mut self, took_ns: i64) {
        match self {
            Self::Live(cadence) => cadence.note_look(took_ns),
            Self::Virtual(budget) => budget.spend_look(),
            Self::Unlimited => {}
        }
    }

    /// Notes a cut of a view and its duration.
    pub(crate) fn note_cut(&mut self, planned: &PlannedView, took_ns: i64) {
        match self {
            Self::Live(cadence) if planned.is_tile() => cadence.note_cut(took_ns),
            Self::Virtual(budget) => budget.spend(planned),
            Self::Live(_) | Self::Unlimited => {}
        }
    }

    /// Notes the search time of a tile, as its worker reports it.
    pub(crate) fn note_search(&mut self, took_ns: i64) {
        if let Self::Live(cadence) = self {
            cadence.note_search(took_ns);
        }
    }

    /// The reason why no time remains for the view `next`: a newer frame, or a spent budget. `None`
    /// if time remains. The flag of `next` is true if it needs a proposal search before.
    pub(crate) fn why_over(
        &self,
        next: Option<(&PlannedView, bool)>,
        is_newer_waiting: bool,
        now_ns: i64,
    ) -> Option<StopReason> {
        match self {
            Self::Live(cadence) => {
                let needs_look = next.is_some_and(|(_, needs_look)| needs_look);
                let has_time = cadence.has_time_to_cut(needs_look, now_ns);
                (is_newer_waiting || !has_time).then_some(StopReason::Newer)
            }
            Self::Virtual(budget) => {
                let is_too_much = |(view, needs_look)| !budget.fits(view, needs_look);
                next.is_some_and(is_too_much).then_some(StopReason::Budget)
            }
            Self::Unlimited => None,
        }
    }

    /// Whether another tile may be sent to the workers while `outstanding` views are in flight.
    ///
    /// In flight, one worker stays free of tiles, which would delay the next frame's regions of
    /// interest. A single worker gets one tile at a time. One more tile is cut ahead if both are
    /// done before the next frame is due.
    pub(crate) fn has_room_for_tile(
        &self,
        outstanding: usize,
        workers: usize,
        now_ns: i64,
    ) -> bool {
        let Self::Live(cadence) = self else { return true };
        let is_ahead = cadence.has_time_to_cut_ahead(now_ns);
        outstanding < workers.saturating_sub(1).max(1) + usize::from(is_ahead)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockeye_config::Profile;

    const MS: i64 = 1_000_000;

    #[test]
    fn one_worker_stays_free_of_tiles_unless_they_are_searched_in_time() {
        let mut cadence = Cadence::default();
        for (sequence, at_ms) in [(0, 100), (1, 130)] {
            let stamp = FrameStamp { sequence, exposure_ns: at_ms * MS, ..FrameStamp::default() };
            cadence.note(&stamp, at_ms * MS);
        }
        let unknown = FrameClock::Live(cadence.clone());
        assert!(unknown.has_room_for_tile(0, 1, 0) && !unknown.has_room_for_tile(1, 2, 0));
        assert!(unknown.has_room_for_tile(1, 3, 0));
        cadence.note_search(5 * MS);
        let quick = FrameClock::Live(cadence);
        assert!(quick.has_room_for_tile(1, 2, 140 * MS));
        assert!(!quick.has_room_for_tile(1, 2, 155 * MS));
        assert!(FrameClock::Unlimited.has_room_for_tile(9, 1, 0));
    }

    #[test]
    fn a_configuration_chooses_the_clock() {
        let of = |profile| FrameClock::of(&Pipeline { profile, ..Pipeline::default() });
        assert!(matches!(of(Profile::Flight), FrameClock::Live(_)));
        assert!(matches!(of(Profile::Repeat), FrameClock::Virtual(_)));
        assert!(matches!(of(Profile::Stills), FrameClock::Virtual(_)));
        assert!(matches!(of(Profile::Unlimited), FrameClock::Unlimited));
    }
}
