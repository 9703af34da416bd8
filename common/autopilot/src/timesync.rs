//! Estimate of the autopilot's clock from the answers to our `TIMESYNC` requests. It reads no
//! clock.
//!
//! An answer contains the autopilot's time between our request and the answer's arrival. So the
//! clock offset lies within half the round trip of the value at its middle. A shorter round trip
//! gives a narrower bound, as in NTP (RFC 5905, section 8). The messages are those of the [time
//! synchronization protocol](https://mavlink.io/en/services/timesync.html). The bound of an older
//! answer is wider, because clocks drift. The answer with the narrowest bound is used. A mean would
//! be biased by delays that are longer one way.

use std::collections::VecDeque;

/// Maximum plausible round trip, nanoseconds.
const LONGEST_ROUND_NS: i64 = 1_000_000_000;
/// Maximum drift between two clocks, parts per million: crystals are within 50 each.
const DRIFT_PPM: i64 = 100;
/// Maximum answers that are kept.
const MAX_ANSWERS: usize = 32;
/// Maximum requests that may still be answered.
const MAX_REQUESTS: usize = 8;
/// Minimum answers for an estimate of the clock.
const LEAST_ANSWERS: usize = 3;
/// Maximum age of an answer, nanoseconds.
const FORGOTTEN_NS: i64 = 60_000_000_000;
/// Answers in a row whose contradiction to the others means another clock: the autopilot was
/// restarted.
const CONTRADICTIONS: usize = 3;
/// Maximum error of an answer beyond its round trip, nanoseconds: stamps are taken by programs.
const SLACK_NS: i64 = 1_000_000;
/// Period of requests before and after the clock is known well, nanoseconds.
const PERIOD_NS: [i64; 2] = [100_000_000, 500_000_000];

/// Offset of the autopilot's clock from CLOCK_MONOTONIC.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TimeOffset {
    /// The autopilot's clock less CLOCK_MONOTONIC, nanoseconds.
    pub autopilot_less_monotonic_ns: i64,
    /// Maximum error of the offset, nanoseconds.
    pub bound_ns: i64,
}

impl TimeOffset {
    /// Converts an instant of CLOCK_MONOTONIC to the autopilot's clock, nanoseconds.
    pub fn autopilot_from_monotonic(&self, monotonic_ns: i64) -> i64 {
        monotonic_ns.saturating_add(self.autopilot_less_monotonic_ns)
    }

    /// Converts an instant of the autopilot's clock to CLOCK_MONOTONIC, nanoseconds.
    pub fn monotonic_from_autopilot(&self, autopilot_ns: i64) -> i64 {
        autopilot_ns.saturating_sub(self.autopilot_less_monotonic_ns)
    }
}

/// The estimate of the autopilot's clock, from a bounded number of answers.
#[derive(Debug, Clone, Default)]
pub(crate) struct Timesync {
    /// `ts1` of each request, which the answer repeats, and its time of sending.
    requests: VecDeque<(i64, i64)>,
    /// Arrival and offset of each answer.
    answers: VecDeque<(i64, TimeOffset)>,
    /// The last answers in a row that contradict the others.
    rivals: Vec<(i64, TimeOffset)>,
}

impl Timesync {
    /// Period of requests, nanoseconds.
    pub(crate) fn period_ns(&self) -> i64 {
        PERIOD_NS[usize::from(self.answers.len() >= 10 && self.rivals.is_empty())]
    }

    /// Notes a request with this `ts1`, sent at `sent_ns` (CLOCK_MONOTONIC).
    pub(crate) fn on_request(&mut self, stamp: i64, sent_ns: i64) {
        if self.requests.len() == MAX_REQUESTS {
            self.requests.pop_front();
        }
        self.requests.push_back((stamp, sent_ns));
    }

    /// Takes an answer, `tc1` and `ts1`, that arrived at `arrived_ns` (CLOCK_MONOTONIC). Answers to
    /// unknown requests, or a second answer, change nothing: other programs send requests on the
    /// same line. Returns whether the autopilot's clock is another than before.
    pub(crate) fn on_answer(&mut self, autopilot_ns: i64, stamp: i64, arrived_ns: i64) -> bool {
        let place = self.requests.iter().position(|(asked, _)| *asked == stamp);
        let Some((_, sent_ns)) = place.and_then(|place| self.requests.remove(place)) else {
            return false;
        };
        let round_ns = arrived_ns.saturating_sub(sent_ns);
        if !(0..LONGEST_ROUND_NS).contains(&round_ns) {
            return false;
        }
        let middle_ns = sent_ns.saturating_add(round_ns / 2);
        let Some(autopilot_less_monotonic_ns) = autopilot_ns.checked_sub(middle_ns) else {
            return false;
        };
        let bound_ns = round_ns / 2 + 1;
        let offset = TimeOffset { autopilot_less_monotonic_ns, bound_ns };
        self.take(arrived_ns, offset)
    }

    /// Returns whether the clock is another than before.
    fn take(&mut self, arrived_ns: i64, offset: TimeOffset) -> bool {
        self.answers.retain(|(at_ns, _)| arrived_ns.saturating_sub(*at_ns).abs() < FORGOTTEN_NS);
        let contradicts = self.best(arrived_ns).is_some_and(|best| {
            let apart =
                best.autopilot_less_monotonic_ns.saturating_sub(offset.autopilot_less_monotonic_ns);
            apart.saturating_abs() > best.bound_ns + offset.bound_ns + SLACK_NS
        });
        if !contradicts {
            self.rivals.clear();
            if self.answers.len() == MAX_ANSWERS {
                self.answers.pop_front();
            }
            self.answers.push_back((arrived_ns, offset));
            return false;
        }
        self.rivals.push((arrived_ns, offset));
        let is_another = self.rivals.len() == CONTRADICTIONS;
        if is_another {
            self.answers = std::mem::take(&mut self.rivals).into();
        }
        is_another
    }

    /// Offset of the autopilot's clock at `now_ns` (CLOCK_MONOTONIC); none before enough answers,
    /// and after a minute without one.
    pub(crate) fn offset(&self, now_ns: i64) -> Option<TimeOffset> {
        self.best(now_ns).filter(|_| self.answers.len() >= LEAST_ANSWERS)
    }

    fn best(&self, now_ns: i64) -> Option<TimeOffset> {
        self.answers
            .iter()
            .filter(|(at_ns, _)| now_ns.saturating_sub(*at_ns) < FORGOTTEN_NS)
            .map(|(at_ns, offset)| {
                // The drift widens the bound with its age.
                let since_ns = now_ns.saturating_sub(*at_ns).clamp(0, FORGOTTEN_NS);
                let drifted_ns = since_ns * DRIFT_PPM / 1_000_000;
                TimeOffset { bound_ns: offset.bound_ns + drifted_ns, ..*offset }
            })
            .min_by_key(|offset| offset.bound_ns)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use proptest::prelude::*;

    use super::*;

    const MS: i64 = 1_000_000;

    /// Requests at these times, which take so long there and back; the autopilot's clock reads what
    /// `clock` says.
    fn ask(
        timesync: &mut Timesync,
        began_ns: i64,
        ways_ns: &[(i64, i64)],
        clock: impl Fn(i64) -> i64,
    ) -> i64 {
        let mut now_ns = began_ns;
        for (there_ns, back_ns) in ways_ns {
            now_ns += 500 * MS;
            timesync.on_request(now_ns, now_ns);
            timesync.on_answer(clock(now_ns + there_ns), now_ns, now_ns + there_ns + back_ns);
        }
        now_ns
    }

    fn ways() -> impl Strategy<Value = Vec<(i64, i64)>> {
        prop::collection::vec((50_000..80 * MS, 50_000..80 * MS), 3..60)
    }

    proptest! {
        /// However unequal the ways, and however the clock drifts.
        #[test]
        fn the_truth_is_within_the_bound(
            offset_ns in -1_700_000_000_000_000_000..1_700_000_000_000_000_000i64,
            drift_ppm in -99..=99i64,
            ways_ns in ways(),
        ) {
            let clock = |now_ns: i64| now_ns + offset_ns + now_ns / 1_000_000 * drift_ppm;
            let mut timesync = Timesync::default();
            let last_ns = ask(&mut timesync, 0, &ways_ns, clock) + 100 * MS;
            let found = timesync.offset(last_ns).unwrap();
            let error_ns = found.autopilot_less_monotonic_ns - (clock(last_ns) - last_ns);
            prop_assert!(error_ns.abs() <= found.bound_ns + 1000, "{error_ns} {found:?}");
            let narrowest = ways_ns.iter().rev().take(32).map(|(there, back)| there + back).min().unwrap();
            prop_assert!(found.bound_ns <= narrowest / 2 + 17 * 100_000);
        }

        #[test]
        fn an_autopilot_that_starts_again_is_followed(before in ways(), after in ways()) {
            let mut timesync = Timesync::default();
            let last_ns = ask(&mut timesync, 0, &before, |now_ns| now_ns + 3_600_000 * MS);
            let clock = |now_ns: i64| now_ns - last_ns;
            let last_ns = ask(&mut timesync, last_ns, &after, clock) + MS;
            let found = timesync.offset(last_ns).unwrap();
            let error_ns = found.autopilot_less_monotonic_ns - (clock(last_ns) - last_ns);
            prop_assert!(error_ns.abs() <= found.bound_ns + 1000, "{error_ns} {found:?}");
        }

        #[test]
        fn numbers_of_all_sizes_do_no_harm(
            numbers in prop::collection::vec((any::<i64>(), any::<i64>(), any::<i64>()), 0..60),
        ) {
            let mut timesync = Timesync::default();
            for (stamp, a, b) in numbers {
                timesync.on_request(stamp, a);
                timesync.on_answer(b, stamp, a.wrapping_add(b % MS));
                timesync.on_answer(a, b, stamp);
                if let Some(offset) = timesync.offset(b) {
                    offset.autopilot_from_monotonic(a);
                    offset.monotonic_from_autopilot(b);
                }
            }
            prop_assert!(timesync.requests.len() <= MAX_REQUESTS);
            prop_assert!(timesync.answers.len() <= MAX_ANSWERS && timesync.rivals.len() < CONTRADICTIONS);
        }
    }

    #[test]
    fn only_what_was_asked_is_an_answer() {
        let mut timesync = Timesync::default();
        for k in 1..50 {
            let now_ns = k * 500 * MS;
            timesync.on_request(now_ns, now_ns);
            // Somebody else's, and one from long ago.
            timesync.on_answer(77, now_ns + 1, now_ns + MS);
            timesync.on_answer(77, now_ns - 500 * MS * 20, now_ns + MS);
        }
        assert_eq!(timesync.offset(25_000 * MS), None);
        // The same answer thrice is one.
        for _ in 0..3 {
            timesync.on_answer(77, 24_500 * MS, 24_501 * MS);
        }
        assert_eq!(timesync.offset(25_000 * MS), None);
    }

    #[test]
    fn a_lie_or_two_are_not_believed_and_silence_is_not_knowledge() {
        let mut timesync = Timesync::default();
        let quick = [(MS, MS); 10];
        let last_ns = ask(&mut timesync, 0, &quick, |now_ns| now_ns + 5000 * MS);
        let last_ns = ask(&mut timesync, last_ns, &quick[..2], |_| i64::MAX / 2);
        let found = timesync.offset(last_ns).unwrap();
        assert!((found.autopilot_less_monotonic_ns - 5000 * MS).abs() <= found.bound_ns);
        assert_eq!(timesync.period_ns(), PERIOD_NS[0], "it is looked into");
        assert_eq!(timesync.offset(last_ns + 61_000 * MS), None);
    }
}
