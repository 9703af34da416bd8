//! What the stages report, as rates.

use std::collections::BTreeMap;

use flockeye_contract::Health;
use flockeye_runtime::health_rates::HealthRates;

use crate::wire;

/// A process that has reported nothing for this long is gone, nanoseconds.
const GONE_NS: i64 = 10_000_000_000;
/// Processes that are kept at most: any process of the user may report anything.
const MOST_PROCESSES: usize = 64;

/// The newest report of each process.
#[derive(Debug, Default)]
pub struct StageReports {
    by_worker: BTreeMap<(String, u32), HealthRates>,
}

impl StageReports {
    /// Takes a report.
    pub fn health(&mut self, health: &Health) {
        let worker = (health.stage.to_string(), health.replica);
        if self.by_worker.len() >= MOST_PROCESSES && !self.by_worker.contains_key(&worker) {
            return;
        }
        self.by_worker.entry(worker).or_insert_with(|| HealthRates::new(health)).take(health);
    }

    /// What is shown of them.
    pub fn shown(&mut self, now_ns: i64) -> wire::Stages {
        self.by_worker.retain(|_, rates| rates.silent_ns(now_ns) < GONE_NS);
        let stages = self.by_worker.iter().map(|((stage, replica), rates)| {
            let last = &rates.last;
            wire::Stage {
                stage: stage.clone(),
                replica: *replica,
                generation: last.generation,
                state: rates.state(now_ns),
                detail: last.detail.to_string(),
                taken_per_s: rates.taken_per_s as f32,
                published_per_s: rates.published_per_s as f32,
                dropped: last.dropped,
                failed: last.failed,
                queued: last.queued,
                processor: rates.processor_share as f32,
                resident_mb: last.resident_bytes as f32 * 1e-6,
                latency_ms: rates.latency_ms.map(|latency| latency.map(|ms| ms as f32)),
            }
        });
        wire::Stages { stages: stages.collect() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockeye_contract::StageState;

    fn health(sent_s: f64, taken: u64) -> Health {
        Health {
            stage: "fusion".into(),
            sent_ns: (sent_s * 1e9) as i64,
            taken,
            pid: 7,
            state: StageState::Ready.code(),
            latency_median_ns: 2_000_000,
            latency_p99_ns: 9_000_000,
            ..Health::default()
        }
    }

    #[test]
    fn rates_follow_the_counters_and_silence_is_named() {
        let mut reports = StageReports::default();
        for step in 0..60 {
            reports.health(&health(f64::from(step) * 0.25, 10 * step as u64));
        }
        let now_ns = 15_000_000_000;
        let shown = reports.shown(now_ns);
        let [stage] = &shown.stages[..] else { panic!("{shown:?}") };
        assert!((stage.taken_per_s - 40.0).abs() < 0.1, "{stage:?}");
        assert_eq!((stage.state, stage.latency_ms), ("ready", Some([2.0, 9.0])));
        assert_eq!(reports.shown(now_ns + 3_000_000_000).stages[0].state, "silent");
        assert!(reports.shown(now_ns + 30_000_000_000).stages.is_empty(), "it is gone");
    }

    #[test]
    fn inventions_do_not_fill_the_memory() {
        let mut reports = StageReports::default();
        for replica in 0..1000 {
            reports.health(&Health { replica, ..health(1.0, 0) });
        }
        assert_eq!(reports.shown(1_000_000_000).stages.len(), MOST_PROCESSES);
    }
}
