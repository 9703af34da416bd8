//! How much of a frame may be cut: by the time in flight, by stated costs in a lossless run.

use flockeye_config::{FrameLimit, Pipeline};
use flockeye_contract::{FrameStamp, PlannedView, StageName, StopReason};

use crate::cadence::Cadence;
use crate::job::Upcoming;
use crate::virtual_budget::VirtualBudget;

/// What decides whether there is time for one more tile of a frame.
#[derive(Debug, Clone)]
pub(crate) enum FrameClock {
    /// The time, in flight.
    Live(Cadence),
    /// Stated costs, in a lossless run that does what flight does.
    Virtual(VirtualBudget),
    /// The plan's own budget of views.
    Unlimited,
}

impl FrameClock {
    /// The clock that a configuration asks for.
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

    /// Whether a plan's own budget of views counts.
    pub(crate) fn is_unlimited(&self) -> bool {
        matches!(self, Self::Unlimited)
    }

    /// A frame came at `now_ns`.
    pub(crate) fn note_arrival(&mut self, stamp: &FrameStamp, now_ns: i64) {
        if let Self::Live(cadence) = self {
            cadence.note(stamp, now_ns);
        }
    }

    /// A frame is taken up.
    pub(crate) fn begin_frame(&mut self, stamp: &FrameStamp) {
        if let Self::Virtual(budget) = self {
            budget.begin_frame(stamp);
        }
    }

    /// The picture was looked at for places like a body, which took `took_ns`.
    pub(crate) fn note_look(&mut self, took_ns: i64) {
        match self {
            Self::Live(cadence) => cadence.note_look(took_ns),
            Self::Virtual(budget) => budget.spend_look(),
            Self::Unlimited => {}
        }
    }

    /// A view was cut, which took `took_ns`.
    pub(crate) fn note_cut(&mut self, planned: &PlannedView, took_ns: i64) {
        match self {
            Self::Live(cadence) if planned.is_tile() => cadence.note_cut(took_ns),
            Self::Virtual(budget) => budget.spend(planned),
            Self::Live(_) | Self::Unlimited => {}
        }
    }

    /// A tile was searched for `took_ns`, as its worker reports.
    pub(crate) fn note_search(&mut self, took_ns: i64) {
        if let Self::Live(cadence) = self {
            cadence.note_search(took_ns);
        }
    }

    /// Why there is no time for the view `next`: a newer frame waits or is due, or the frame's
    /// budget is spent. `None` where there is.
    pub(crate) fn why_over(
        &self,
        next: Option<Upcoming<'_>>,
        is_newer_waiting: bool,
        now_ns: i64,
    ) -> Option<StopReason> {
        match self {
            Self::Live(cadence) => {
                let needs_look = next.is_some_and(|next| next.needs_look);
                let has_time = cadence.has_time_to_cut(needs_look, now_ns);
                (is_newer_waiting || !has_time).then_some(StopReason::Newer)
            }
            Self::Virtual(budget) => {
                next.is_some_and(|next| !budget.fits(next)).then_some(StopReason::Budget)
            }
            Self::Unlimited => None,
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
