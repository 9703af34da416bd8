//! Rates from successive health reports of a process.

use flockeye_contract::{Health, StageState};

/// Silence after which a process is shown as silent, nanoseconds.
const SILENCE_NS: i64 = 2_000_000_000;
/// Minimum interval of a rate, seconds.
const MIN_SPAN_S: f64 = 0.1;
/// Weight of a new rate in the smoothed one, which is displayed.
const BLEND: f64 = 0.3;

/// The newest report of a process, and rates that are smoothed over some reports.
#[derive(Debug, Clone)]
pub struct HealthRates {
    /// The newest report.
    pub last: Health,
    /// Messages taken per second.
    pub taken_per_s: f64,
    /// Messages published per second.
    pub published_per_s: f64,
    /// Number of processors in use.
    pub processor_share: f64,
    /// Median and 99 % quantile of its last reported latency, milliseconds.
    pub latency_ms: Option<[f64; 2]>,
}

impl HealthRates {
    /// Starts with the first report.
    pub fn new(first: &Health) -> Self {
        let mut rates = Self {
            last: *first,
            taken_per_s: 0.0,
            published_per_s: 0.0,
            processor_share: 0.0,
            latency_ms: None,
        };
        rates.take(first);
        rates
    }

    /// Takes the next report.
    pub fn take(&mut self, health: &Health) {
        let last = &self.last;
        let span_s = health.sent_ns.saturating_sub(last.sent_ns) as f64 * 1e-9;
        if health.pid == last.pid && span_s > MIN_SPAN_S {
            let rate = |now: u64, before: u64| now.saturating_sub(before) as f64 / span_s;
            let blend = |shown: &mut f64, new: f64| *shown += BLEND * (new - *shown);
            blend(&mut self.taken_per_s, rate(health.taken, last.taken));
            blend(&mut self.published_per_s, rate(health.published, last.published));
            blend(&mut self.processor_share, rate(health.processor_ns, last.processor_ns) * 1e-9);
        }
        if health.latency_median_ns >= 0 {
            let latency_ns = [health.latency_median_ns, health.latency_p99_ns];
            self.latency_ms = Some(latency_ns.map(|ns| ns as f64 * 1e-6));
        }
        self.last = *health;
    }

    /// Time since the last report, nanoseconds.
    pub fn silent_ns(&self, now_ns: i64) -> i64 {
        now_ns.saturating_sub(self.last.sent_ns)
    }

    /// Whether the stage is silent.
    pub fn is_silent(&self, now_ns: i64) -> bool {
        self.silent_ns(now_ns) > SILENCE_NS
    }

    /// State in a word, or `silent`.
    pub fn state(&self, now_ns: i64) -> &'static str {
        match self.is_silent(now_ns) {
            true => "silent",
            false => StageState::try_from(self.last.state).map_or("unknown", StageState::name),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn health(sent_s: f64, taken: u64, pid: u32) -> Health {
        Health {
            sent_ns: (sent_s * 1e9) as i64,
            taken,
            pid,
            state: StageState::Ready.code(),
            latency_median_ns: -1,
            ..Health::default()
        }
    }

    #[test]
    fn rates_follow_the_counters_and_silence_is_named() {
        let mut rates = HealthRates::new(&health(0.0, 0, 7));
        for step in 1..60 {
            rates.take(&health(f64::from(step) * 0.25, 10 * step as u64, 7));
        }
        assert!((rates.taken_per_s - 40.0).abs() < 0.1, "{rates:?}");
        assert_eq!((rates.latency_ms, rates.state(15_000_000_000)), (None, "ready"));
        assert_eq!(rates.state(18_000_000_000), "silent");
        // Another process counts from nothing.
        rates.take(&health(15.0, 3, 8));
        assert!((rates.taken_per_s - 40.0).abs() < 0.1, "{rates:?}");
    }
}
