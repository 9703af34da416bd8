//! Schedule of passes, and the time budget of a frame.

use flockeye_config::Costs;
use flockeye_contract::{FrameOrder, FrameStamp};

use crate::policy::TimeBudget;

/// Schedule of passes.
#[derive(Debug, Clone)]
pub(crate) enum Schedule {
    /// As soon as their inputs have arrived, in the remaining time.
    Flight,
    /// As in flight, but in a lossless run: with stated costs instead of the time, so that results
    /// do not depend on the speed of the machine.
    Virtual(VirtualClock),
    /// All of them when a frame is complete.
    Unlimited,
}

/// Number of newer frames after which a frame is behind.
const BEHIND_FRAMES: u64 = 2;

impl Schedule {
    /// Time budget of the passes of a frame. `newest` is the newest frame that has arrived.
    pub(crate) fn budget(&self, stamp: &FrameStamp, newest: Option<&FrameStamp>) -> TimeBudget {
        let is_behind = match self {
            Self::Flight => is_behind(stamp, newest),
            Self::Virtual(clock) => clock.is_behind(stamp),
            Self::Unlimited => return TimeBudget::Unlimited,
        };
        if is_behind { TimeBudget::Overspent } else { TimeBudget::OneFrame }
    }

    /// Whether passes run as soon as their inputs have arrived.
    pub(crate) fn is_flight(&self) -> bool {
        matches!(self, Self::Flight)
    }

    /// Whether regions of interest are measured before they are searched.
    pub(crate) fn has_direct_pass(&self) -> bool {
        !matches!(self, Self::Unlimited)
    }
}

/// Whether newer frames have arrived, so that a frame's time is spent.
fn is_behind(stamp: &FrameStamp, newest: Option<&FrameStamp>) -> bool {
    newest.is_some_and(|newest| {
        stamp.is_late_beside(newest)
            && newest.sequence.wrapping_sub(stamp.sequence) >= BEHIND_FRAMES
    })
}

/// Number of attempts to measure a target, with or without success.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Attempts {
    pub(crate) direct: u32,
    /// Corner passes with a prediction.
    pub(crate) tracked: u32,
    /// Corner passes without one.
    pub(crate) untracked: u32,
}

/// A clock that only stated costs advance. Each frame begins at its exposure, or at the end of the
/// work on the frame before.
#[derive(Debug, Clone)]
pub(crate) struct VirtualClock {
    costs: Costs,
    last: Option<FrameStamp>,
    interval_ns: i64,
    /// The time, on the clock of the exposures, nanoseconds.
    now_ns: i64,
    /// End of the last background pass.
    pub(crate) background_over_ns: i64,
}

impl VirtualClock {
    /// Creates a clock with these costs, before the first frame.
    pub(crate) fn new(costs: Costs) -> Self {
        Self { costs, last: None, interval_ns: 0, now_ns: i64::MIN, background_over_ns: i64::MIN }
    }

    /// Begins a frame.
    pub(crate) fn begin_frame(&mut self, stamp: &FrameStamp) {
        let source = |stamp: &FrameStamp| (stamp.source_generation, stamp.epoch);
        let goes_on = self.last.is_some_and(|last| source(&last) == source(stamp));
        self.now_ns = if goes_on { self.now_ns.max(stamp.exposure_ns) } else { stamp.exposure_ns };
        self.interval_ns = self.last.and_then(|last| stamp.interval_ns(&last)).unwrap_or_default();
        self.last = Some(*stamp);
    }

    /// Adds the costs of passes.
    pub(crate) fn spend(&mut self, attempts: Attempts) {
        let Attempts { direct, tracked, untracked } = attempts;
        let costs = &self.costs;
        self.spend_ms(
            f64::from(direct) * costs.direct_pass_ms
                + f64::from(tracked) * costs.corner_pass_ms
                + f64::from(untracked) * costs.initiation_ms,
        );
    }

    fn spend_ms(&mut self, ms: f64) {
        self.now_ns = self.now_ns.saturating_add((ms * 1e6) as i64);
    }

    /// Ends the search of a frame: in flight, that is when the next one is due.
    pub(crate) fn complete_frame(&mut self, stamp: &FrameStamp) {
        self.now_ns = self.now_ns.max(stamp.exposure_ns.saturating_add(self.interval_ns));
    }

    /// Begins a background pass. Only one runs at a time.
    pub(crate) fn begin_background(&mut self) {
        let cost_ns = (self.costs.background_pass_ms * 1e6) as i64;
        self.background_over_ns = self.now_ns.saturating_add(cost_ns);
    }

    /// Whether a background pass over a frame that ends at that time is over. A pass over a frame
    /// of another source always is, because its clock differs.
    pub(crate) fn is_over(&self, over_ns: i64, order: FrameOrder) -> bool {
        let of_source = |last: FrameStamp| (last.source_generation, last.epoch);
        over_ns <= self.now_ns || self.last.map(of_source) != Some((order.0, order.1))
    }

    fn is_behind(&self, stamp: &FrameStamp) -> bool {
        let late_ns = self.now_ns.saturating_sub(stamp.exposure_ns);
        self.interval_ns > 0 && late_ns > BEHIND_FRAMES as i64 * self.interval_ns
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixtures::stamp;

    const MS: i64 = 1_000_000;

    #[test]
    fn a_frame_is_behind_when_two_newer_ones_have_come() {
        assert!(!is_behind(&stamp(5), None));
        assert!(!is_behind(&stamp(5), Some(&stamp(6))));
        assert!(is_behind(&stamp(5), Some(&stamp(7))));
        assert!(!is_behind(&stamp(7), Some(&stamp(5))), "it is newer itself");
    }

    #[test]
    fn each_pass_costs_what_is_stated() {
        let costs = Costs {
            direct_pass_ms: 3.0,
            corner_pass_ms: 5.0,
            initiation_ms: 7.0,
            ..Costs::default()
        };
        let mut clock = VirtualClock::new(costs);
        clock.begin_frame(&FrameStamp::default());
        clock.spend(Attempts { direct: 1, tracked: 2, untracked: 3 });
        assert_eq!(clock.now_ns, 34 * MS);
    }

    #[test]
    fn only_costs_and_exposures_move_a_virtual_clock() {
        let at = |sequence: u64| FrameStamp {
            sequence,
            exposure_ns: 40 * MS * sequence as i64,
            ..FrameStamp::default()
        };
        let mut clock = VirtualClock::new(Costs { background_pass_ms: 30.0, ..Costs::default() });
        clock.begin_frame(&at(1));
        clock.spend_ms(5.0);
        clock.complete_frame(&at(1));
        assert_eq!(clock.now_ns, 45 * MS, "the interval is not known yet");
        clock.begin_frame(&at(2));
        assert_eq!(clock.now_ns, 80 * MS);
        clock.spend_ms(15.0);
        clock.begin_background();
        clock.spend_ms(3.0);
        assert_eq!(clock.background_over_ns, 125 * MS);
        clock.complete_frame(&at(2));
        assert_eq!(clock.now_ns, 120 * MS);
        clock.begin_frame(&at(3));
        clock.spend_ms(79.0);
        assert!(!clock.is_behind(&at(3)));
        clock.spend_ms(2.0);
        assert!(clock.is_behind(&at(3)), "two frames would have come");
        let again = FrameStamp { epoch: 1, ..at(0) };
        clock.begin_frame(&again);
        assert_eq!(clock.now_ns, 0, "the source has started again");
        assert!(clock.is_over(90 * MS, at(2).order()), "a pass over a frame of before");
        assert!(!clock.is_over(90 * MS, again.order()) && clock.is_over(0, again.order()));
    }
}
