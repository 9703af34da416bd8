//! Freshness of reports: a fresh report was not delayed on the way, not received before, and has no
//! future time.

use flockeye_runtime::clock::monotonic_ns;

use crate::clock::OneWay;
use crate::refusal::Refusal;
use crate::utc::utc_from_monotonic;

/// Maximum delay above the minimum transit time, nanoseconds; later reports are refused as stale.
const STALE_NS: i64 = 1_000_000_000;
/// Maximum lead over the minimum transit time, nanoseconds; earlier reports are refused as from the
/// future.
const FUTURE_NS: i64 = 1_000_000_000;
/// Time without an accepted report after which the observer's times start anew, nanoseconds. The
/// drone was restarted by then, or its clock was set.
const ANEW_AFTER_NS: i64 = 3_000_000_000;

/// One instant by this machine's two clocks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClockReading {
    /// CLOCK_MONOTONIC, nanoseconds.
    pub monotonic_ns: i64,
    /// UTC by our clock, nanoseconds since 1970.
    pub utc_ns: i64,
    /// Whether our clock is synchronised with UTC.
    pub is_synchronised: bool,
}

impl ClockReading {
    /// Reads both clocks now.
    pub fn now() -> Self {
        let monotonic_ns = monotonic_ns();
        let (utc_ns, is_synchronised) = utc_from_monotonic(monotonic_ns);
        Self { monotonic_ns, utc_ns, is_synchronised }
    }

    /// Our UTC less our CLOCK_MONOTONIC, nanoseconds.
    pub fn utc_less_monotonic_ns(&self) -> i64 {
        self.utc_ns.saturating_sub(self.monotonic_ns)
    }
}

/// Times of one observer's reports.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Freshness {
    /// Transit times, which contain the offset of the observer's clock.
    pub(crate) way: OneWay,
    last_passed_ns: Option<i64>,
    /// Time of sending of the newest report, by the observer's clock.
    newest_utc_ns: Option<i64>,
    /// Times of sending and arrival of the observer's last answer, where reports are signed.
    answer: Option<(i64, i64)>,
}

impl Freshness {
    /// Whether the next report is the first, or the first after a silence.
    pub(crate) fn begins_anew(&self, arrival: &ClockReading) -> bool {
        self.last_passed_ns
            .is_none_or(|last| arrival.monotonic_ns.saturating_sub(last) > ANEW_AFTER_NS)
    }

    /// Starts anew with an answer that was just requested.
    pub(crate) fn begin(&mut self, sent_utc_ns: i64, arrival: &ClockReading) {
        *self = Self::default();
        self.way.add(sent_utc_ns, arrival.monotonic_ns);
        self.last_passed_ns = Some(arrival.monotonic_ns);
        self.newest_utc_ns = Some(sent_utc_ns);
        self.answer = Some((sent_utc_ns, arrival.monotonic_ns));
    }

    /// Notes an answer, which may be older than published reports.
    pub(crate) fn note(&mut self, sent_utc_ns: i64) {
        self.newest_utc_ns = self.newest_utc_ns.max(Some(sent_utc_ns));
    }

    /// Accepts a published report, or returns why it is not fresh. `is_synchronised`: whether the
    /// sender's clock is synchronised with UTC.
    pub(crate) fn pass(
        &mut self,
        sent_utc_ns: i64,
        is_synchronised: bool,
        arrival: &ClockReading,
    ) -> Result<(), Refusal> {
        if self.begins_anew(arrival) {
            (self.way, self.newest_utc_ns) = (OneWay::default(), None);
        }
        self.check(sent_utc_ns, is_synchronised, arrival)?;
        self.way.add(sent_utc_ns, arrival.monotonic_ns);
        self.last_passed_ns = Some(arrival.monotonic_ns);
        self.newest_utc_ns = Some(sent_utc_ns);
        Ok(())
    }

    fn check(
        &self,
        sent_utc_ns: i64,
        is_synchronised: bool,
        arrival: &ClockReading,
    ) -> Result<(), Refusal> {
        let late_ns = if is_synchronised && arrival.is_synchronised {
            Some(arrival.utc_ns.saturating_sub(sent_utc_ns))
        } else {
            self.way.above_least(sent_utc_ns, arrival.monotonic_ns)
        };
        let late_ns = late_ns.unwrap_or(0);
        let mut newest_utc_ns = self.newest_utc_ns;
        if let Some((answer_utc_ns, arrived_ns)) = self.answer {
            let before_ns = answer_utc_ns.saturating_sub(sent_utc_ns);
            if (0..STALE_NS).contains(&before_ns) {
                return Err(Refusal::Overtaken);
            }
            newest_utc_ns = newest_utc_ns.max(Some(answer_utc_ns));
            // An attacker that delays each report a little longer shifts the minimum transit time.
            // The time of the answer stays.
            let since_answer_ns = arrival.monotonic_ns.saturating_sub(arrived_ns);
            let late_ns = since_answer_ns.saturating_add(before_ns);
            if before_ns < 0 && late_ns > STALE_NS {
                return Err(Refusal::Stale { late_ms: late_ns / 1_000_000 });
            }
        }
        if late_ns > STALE_NS {
            return Err(Refusal::Stale { late_ms: late_ns / 1_000_000 });
        }
        if late_ns < -FUTURE_NS {
            return Err(Refusal::Future { early_ms: -(late_ns / 1_000_000) });
        }
        match newest_utc_ns {
            Some(newest) if sent_utc_ns <= newest => {
                Err(Refusal::Replayed { older_ms: newest.saturating_sub(sent_utc_ns) / 1_000_000 })
            }
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    const UTC: i64 = 1_700_000_000_000_000_000;
    const SECOND: i64 = 1_000_000_000;

    fn at(monotonic_ns: i64, is_synchronised: bool) -> ClockReading {
        ClockReading { monotonic_ns, utc_ns: monotonic_ns + UTC, is_synchronised }
    }

    /// A report sent at `sent_ns` (by a clock that is a day wrong) that arrives at `arrived_ns`.
    fn pass(freshness: &mut Freshness, sent_ns: i64, arrived_ns: i64) -> Result<(), Refusal> {
        freshness.pass(sent_ns + UTC - 86_400 * SECOND, false, &at(arrived_ns, true))
    }

    #[test]
    fn reports_that_flow_pass_whatever_the_clock_says() {
        let mut freshness = Freshness::default();
        for k in 0..1_000 {
            let delay = [2, 40, 3, 900][k as usize % 4] * 1_000_000;
            pass(&mut freshness, k * 33_000_000, k * 33_000_000 + delay).unwrap();
        }
    }

    #[test]
    fn what_was_held_back_said_twice_or_is_to_come_is_refused() {
        let mut freshness = Freshness::default();
        pass(&mut freshness, 0, 1_000_000).unwrap();
        let held = pass(&mut freshness, SECOND / 10, 3 * SECOND / 2);
        assert!(matches!(held, Err(Refusal::Stale { late_ms: 1399 })), "{held:?}");
        pass(&mut freshness, SECOND, SECOND + 1_000_000).unwrap();
        let twice = pass(&mut freshness, SECOND, SECOND + 9_000_000);
        assert!(matches!(twice, Err(Refusal::Replayed { older_ms: 0 })));
        let early = pass(&mut freshness, 9 * SECOND, 2 * SECOND);
        assert!(matches!(early, Err(Refusal::Future { .. })));
        pass(&mut freshness, 2 * SECOND, 2 * SECOND + 1_000_000).expect("others go on");
    }

    #[test]
    fn a_clock_that_was_set_costs_three_seconds() {
        let mut freshness = Freshness::default();
        pass(&mut freshness, 100 * SECOND, 100 * SECOND).unwrap();
        let passed: Vec<bool> = (0..50)
            .map(|k| {
                let now = 100 * SECOND + k * SECOND / 10;
                // Set back by a minute.
                pass(&mut freshness, now - 60 * SECOND, now).is_ok()
            })
            .collect();
        assert_eq!(passed.iter().position(|passed| *passed), Some(31));
        assert!(passed[31..].iter().all(|passed| *passed));
    }

    /// By the quickest of the last 40 s alone, whoever holds reports back could let their age grow
    /// without end.
    #[test]
    fn after_an_answer_nothing_is_held_back_longer_and_longer() {
        let mut freshness = Freshness::default();
        freshness.begin(UTC, &at(0, false));
        let passed = (1..6_000).take_while(|k| {
            let sent_ns = k * SECOND / 20;
            // Held back by one part in fifty.
            let arrived = at(sent_ns + sent_ns / 50, false);
            freshness.pass(UTC + sent_ns, false, &arrived).is_ok()
        });
        assert_eq!(passed.count(), 20 * 50, "until a second is reached");
        let overtaken = freshness.pass(UTC - 1, false, &at(SECOND / 10, false));
        assert!(matches!(overtaken, Err(Refusal::Overtaken)));
    }

    /// With both clocks synchronised not even the first report can be an old one.
    #[test]
    fn between_synchronised_clocks_an_old_report_never_passes() {
        let mut freshness = Freshness::default();
        let now = at(50 * SECOND, true);
        let old = freshness.pass(UTC + 40 * SECOND, true, &now);
        assert!(matches!(old, Err(Refusal::Stale { late_ms: 10_000 })));
        let early = freshness.pass(UTC + 52 * SECOND, true, &now);
        assert!(matches!(early, Err(Refusal::Future { early_ms: 2_000 })));
        freshness.pass(UTC + 50 * SECOND - 2_000_000, true, &now).unwrap();
        let unsure = at(50 * SECOND, false);
        Freshness::default().pass(UTC, true, &unsure).expect("by our clock alone none is old");
    }
}
