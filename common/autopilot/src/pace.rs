//! Rate limit of repeated messages. It reads no clock.

/// Limits a rate: in any time at most as many messages as the rate allows, plus two.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Pace {
    /// Minimum time between two messages on average; none: never.
    period_ns: Option<i64>,
    due_ns: i64,
}

impl Pace {
    /// A pace of at most `hz` a second; 0: never.
    pub(crate) fn from_hz(hz: f64) -> Self {
        let period_ns = (hz > 0.0).then(|| (1e9 / hz) as i64);
        Self { period_ns, due_ns: i64::MIN }
    }

    /// Whether a message may be sent at `now_ns`.
    pub(crate) fn is_due(&self, now_ns: i64) -> bool {
        self.period_ns.is_some() && now_ns >= self.due_ns
    }

    /// Time from which the next message may be sent; none: never.
    pub(crate) fn due_ns(&self) -> Option<i64> {
        self.period_ns.map(|_| self.due_ns)
    }

    /// Notes a message that was sent at `now_ns`. Messages follow frames, and are seldom sent
    /// exactly when due. So the next is due one period after this one was due, which holds the mean
    /// rate. It is due at least half a period from now, so that no two follow at once.
    pub(crate) fn sent(&mut self, now_ns: i64) {
        let Some(period_ns) = self.period_ns else { return };
        self.due_ns =
            self.due_ns.saturating_add(period_ns).max(now_ns.saturating_add(period_ns / 2));
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// How many of the attempts at these times are let through.
    fn count(hz: f64, attempts_ns: impl Iterator<Item = i64>) -> Vec<i64> {
        let mut pace = Pace::from_hz(hz);
        attempts_ns
            .filter(|now_ns| {
                let is_due = pace.is_due(*now_ns);
                if is_due {
                    pace.sent(*now_ns);
                }
                is_due
            })
            .collect()
    }

    #[test]
    fn the_mean_rate_is_held_though_frames_do_not_fit_it() {
        // 30 frames a second for 60 s.
        let frames = || (0..1800).map(|frame| frame * 1_000_000_000 / 30);
        assert!((1190..=1202).contains(&count(20.0, frames()).len()));
        assert!((890..=902).contains(&count(15.0, frames()).len()));
        assert_eq!(count(100.0, frames()).len(), 1800, "no more than there are");
        assert_eq!(count(0.0, frames()).len(), 0);
    }

    proptest! {
        /// Over each stretch of time.
        #[test]
        fn never_more_than_the_rate(
            hz in 0.5..100.0f64,
            gaps_ns in prop::collection::vec(0..400_000_000i64, 1..300),
        ) {
            let mut now_ns = 0;
            let attempts: Vec<i64> = gaps_ns.iter().map(|gap| { now_ns += gap; now_ns }).collect();
            let sent = count(hz, attempts.into_iter());
            for first in 0..sent.len() {
                for last in first..sent.len() {
                    let stretch_s = (sent[last] - sent[first]) as f64 * 1e-9;
                    prop_assert!((last - first + 1) as f64 <= stretch_s * hz + 2.0 + 1e-6);
                }
            }
        }
    }
}
