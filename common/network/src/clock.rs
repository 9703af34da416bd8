//! Estimate of the offset between a peer's clock and this machine's, from the reports themselves.
//!
//! A report contains its time of sending by its sender's clock. So each gives the transit time plus
//! the clocks' offset. The minimum of many is the offset plus the shortest transit time. The peer
//! reports the same for our reports (`clocks` in its report). Half the difference of the two is the
//! clocks' offset, if the shortest transit times are equal both ways. NTP uses the same formula
//! (Mills, RFC 5905, section 8).

use flockeye_contract::wire::ClockOffset;

/// The minimum is taken over this time and the same time before, nanoseconds. Clocks that drift
/// apart by 50 ppm move by a millisecond in it.
const WINDOW_NS: i64 = 20_000_000_000;
/// Weight of a new value in the mean delay above the minimum.
const MEAN_SHARE: f64 = 0.05;
/// Minimum standard deviation of an estimate, nanoseconds: waking a thread takes as long.
const LEAST_DEVIATION_NS: f64 = 50_000.0;
/// Shortest transit time where the peer does not report it, nanoseconds; typical of one radio.
const ONE_WAY_GUESS_NS: f64 = 1_000_000.0;
/// Maximum plausible round trip, nanoseconds.
const LONGEST_ROUND_NS: i64 = 1_000_000_000;

/// Transit times: from sending by the peer's clock (UTC) to arrival by ours (CLOCK_MONOTONIC),
/// nanoseconds.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct OneWay {
    /// The minimum of this window and of the one before.
    least: [Option<i64>; 2],
    window_began_ns: i64,
    mean_above: f64,
    /// The minimum that the peer reports for our reports: arrival by its clock less sending by
    /// ours, both UTC.
    back: Option<i64>,
}

/// Offset of a peer's clock from ours.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClockEstimate {
    /// The peer's UTC less our CLOCK_MONOTONIC, nanoseconds.
    pub utc_less_monotonic_ns: i64,
    /// The peer's UTC less ours, nanoseconds.
    pub offset_ns: i64,
    /// Standard deviation of both offsets, nanoseconds.
    pub deviation_ns: i64,
    /// Minimum of arrival by our UTC less sending by the peer's, nanoseconds.
    pub one_way_ns: i64,
    /// Whether the estimate uses the peer's minimum for our reports.
    pub is_two_way: bool,
}

impl OneWay {
    /// Delay of a report above the minimum transit time, nanoseconds; none before the first.
    pub(crate) fn above_least(&self, sent_utc_ns: i64, arrived_ns: i64) -> Option<i64> {
        Some(arrived_ns.saturating_sub(sent_utc_ns).saturating_sub(self.least()?))
    }

    fn least(&self) -> Option<i64> {
        self.least.into_iter().flatten().min()
    }

    /// Adds a report with these times of sending and arrival.
    pub(crate) fn add(&mut self, sent_utc_ns: i64, arrived_ns: i64) {
        if self.least().is_none() {
            self.window_began_ns = arrived_ns;
        } else if arrived_ns.saturating_sub(self.window_began_ns) > WINDOW_NS {
            self.least = [None, self.least[0]];
            self.window_began_ns = arrived_ns;
        }
        let way = arrived_ns.saturating_sub(sent_utc_ns);
        self.least[0] = Some(self.least[0].map_or(way, |least| least.min(way)));
        let above = way.saturating_sub(self.least().unwrap_or(way)) as f64;
        self.mean_above += MEAN_SHARE * (above - self.mean_above);
    }

    /// Takes the peer's minimum for our own reports.
    pub(crate) fn hear_back(&mut self, said: &ClockOffset) {
        let nanoseconds = said.one_way_ms * 1e6;
        if nanoseconds.is_finite() && nanoseconds.abs() < 9e18 {
            self.back = Some(nanoseconds as i64);
        }
    }

    /// The estimate, where our UTC is `own_utc_less_monotonic_ns` ahead of CLOCK_MONOTONIC. None
    /// before the first report.
    pub(crate) fn estimate(&self, own_utc_less_monotonic_ns: i64) -> Option<ClockEstimate> {
        let one_way_ns = self.least()?.saturating_add(own_utc_less_monotonic_ns);
        let round = self.back.map(|back| (back, back.saturating_add(one_way_ns)));
        // A round trip that is negative or very long is invalid. Then the peer's value is false, or
        // one of the clocks was set meanwhile.
        let round = round.filter(|(_, round)| (-1_000_000..LONGEST_ROUND_NS).contains(round));
        let (offset_ns, deviation, is_two_way) = match round {
            // The transit time one way may be any share of the round trip: a uniform distribution.
            Some((back, round)) => {
                let deviation = round.max(0) as f64 / 2.0 / 3f64.sqrt();
                (back.saturating_sub(one_way_ns) / 2, deviation, true)
            }
            None => {
                let guess = ONE_WAY_GUESS_NS.max(self.mean_above);
                (one_way_ns.saturating_neg().saturating_add(guess as i64), guess, false)
            }
        };
        Some(ClockEstimate {
            utc_less_monotonic_ns: offset_ns.saturating_add(own_utc_less_monotonic_ns),
            offset_ns,
            deviation_ns: deviation.max(LEAST_DEVIATION_NS) as i64,
            one_way_ns,
            is_two_way,
        })
    }
}

impl ClockEstimate {
    /// Converts an instant of the peer's clock to ours, CLOCK_MONOTONIC.
    pub fn monotonic_from_utc(&self, utc_ns: i64) -> i64 {
        utc_ns.saturating_sub(self.utc_less_monotonic_ns)
    }

    /// The estimate in the format of reports.
    pub fn to_wire(self) -> ClockOffset {
        ClockOffset {
            one_way_ms: self.one_way_ns as f64 * 1e-6,
            offset_ms: self.offset_ns as f64 * 1e-6,
            deviation_ms: self.deviation_ns as f64 * 1e-6,
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use proptest::prelude::*;

    use super::*;

    /// Our UTC less our CLOCK_MONOTONIC.
    const UTC: i64 = 1_700_000_000_000_000_000;

    /// Reports of a peer whose clock is ahead by `offset_ns`, each so long on the air.
    fn hear(offset_ns: i64, delays_ns: &[i64]) -> OneWay {
        let mut way = OneWay::default();
        for (k, delay) in delays_ns.iter().enumerate() {
            let sent_ns = 33_000_000 * k as i64;
            way.add(sent_ns + UTC + offset_ns, sent_ns + delay);
        }
        way
    }

    fn delays() -> impl Strategy<Value = Vec<i64>> {
        prop::collection::vec(100_000..30_000_000i64, 30..60)
    }

    proptest! {
        /// The truth lies within half the shortest way there and back.
        #[test]
        fn two_ways_bound_the_offset(
            offset_ns in -3_600_000_000_000..3_600_000_000_000i64,
            there in delays(),
            back in delays(),
        ) {
            let mut ours = hear(offset_ns, &there);
            let theirs = hear(-offset_ns, &back).estimate(UTC).unwrap();
            ours.hear_back(&theirs.to_wire());
            let estimate = ours.estimate(UTC).unwrap();
            let round = there.iter().min().unwrap() + back.iter().min().unwrap();
            prop_assert!(estimate.is_two_way);
            prop_assert!((estimate.offset_ns - offset_ns).abs() <= round / 2 + 1_000);
            let bound = 3f64.sqrt() * estimate.deviation_ns as f64 + 2_000.0;
            prop_assert!(((estimate.offset_ns - offset_ns) as f64).abs() <= bound);
        }

        #[test]
        fn numbers_of_all_sizes_do_no_harm(sent in any::<i64>(), arrived in any::<i64>(), back in any::<f64>()) {
            let mut way = OneWay::default();
            way.add(sent, arrived);
            way.add(arrived, sent);
            way.hear_back(&ClockOffset { one_way_ms: back, offset_ms: 0.0, deviation_ms: 0.0 });
            let estimate = way.estimate(sent).unwrap();
            prop_assert!(estimate.deviation_ns > 0);
            estimate.monotonic_from_utc(arrived);
        }
    }

    #[test]
    fn without_the_way_back_the_guess_covers_a_short_way() {
        let estimate = hear(5_000_000, &[900_000, 1_500_000, 700_000]).estimate(UTC).unwrap();
        assert!(!estimate.is_two_way);
        let error = (estimate.offset_ns - 5_000_000) as f64;
        assert!(error.abs() <= 2.0 * estimate.deviation_ns as f64, "{error}");
    }

    #[test]
    fn a_lie_about_the_way_back_is_not_believed() {
        let mut way = hear(0, &[500_000]);
        for lie in [-50.0, 1e9, f64::NAN] {
            way.hear_back(&ClockOffset { one_way_ms: lie, offset_ms: 0.0, deviation_ms: 0.0 });
            assert!(!way.estimate(UTC).unwrap().is_two_way, "{lie}");
        }
    }

    /// A clock that runs 50 ppm fast is followed, because old windows are forgotten.
    #[test]
    fn a_drifting_clock_is_followed() {
        let mut way = OneWay::default();
        for second in 0..600i64 {
            let sent_ns = second * 1_000_000_000;
            way.add(sent_ns + UTC - second * 50_000, sent_ns + 500_000);
        }
        let error = way.estimate(UTC).unwrap().offset_ns + 599 * 50_000;
        assert!(error.abs() < 3_500_000, "{error} ns");
    }
}
