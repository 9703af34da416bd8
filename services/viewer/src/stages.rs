//! What the stages report, as rates.

use std::collections::BTreeMap;

use flockeye_contract::{Health, StageState};

use crate::wire;

/// A stage that has reported nothing for this long is silent, nanoseconds.
const SILENCE_NS: i64 = 1_500_000_000;
/// A process that has reported nothing for this long is gone, nanoseconds.
const GONE_NS: i64 = 10_000_000_000;
/// Rates are taken over at least this long, seconds.
const MIN_SPAN_S: f64 = 0.1;
/// Share of a new rate in the one that is shown: people read it.
const BLEND: f32 = 0.3;
/// Processes that are kept at most: any process of the user may report anything.
const MOST_PROCESSES: usize = 64;

/// The newest report of each process.
#[derive(Debug, Default)]
pub struct StageReports {
    by_worker: BTreeMap<(String, u32), Report>,
}

#[derive(Debug)]
struct Report {
    last: Health,
    taken_per_s: f32,
    published_per_s: f32,
    processor: f32,
    latency_ms: Option<[f32; 2]>,
}

impl StageReports {
    /// Takes a report.
    pub fn health(&mut self, health: &Health) {
        let worker = (health.stage.to_string(), health.replica);
        if self.by_worker.len() >= MOST_PROCESSES && !self.by_worker.contains_key(&worker) {
            return;
        }
        let report = self.by_worker.entry(worker).or_insert_with(|| Report {
            last: *health,
            taken_per_s: 0.0,
            published_per_s: 0.0,
            processor: 0.0,
            latency_ms: None,
        });
        let span_s = health.sent_ns.saturating_sub(report.last.sent_ns) as f64 * 1e-9;
        if health.pid == report.last.pid && span_s > MIN_SPAN_S {
            let rate = |now: u64, then: u64| (now.saturating_sub(then) as f64 / span_s) as f32;
            let blend = |shown: &mut f32, new: f32| *shown += BLEND * (new - *shown);
            let last = &report.last;
            blend(&mut report.taken_per_s, rate(health.taken, last.taken));
            blend(&mut report.published_per_s, rate(health.published, last.published));
            blend(&mut report.processor, rate(health.processor_ns, last.processor_ns) * 1e-9);
        }
        if health.latency_median_ns >= 0 {
            let ms = |ns: i64| (ns as f64 * 1e-6) as f32;
            report.latency_ms = Some([ms(health.latency_median_ns), ms(health.latency_p99_ns)]);
        }
        report.last = *health;
    }

    /// What is shown of them.
    pub fn shown(&mut self, now_ns: i64) -> wire::Stages {
        let silent_ns = |report: &Report| now_ns.saturating_sub(report.last.sent_ns);
        self.by_worker.retain(|_, report| silent_ns(report) < GONE_NS);
        let stages = self.by_worker.iter().map(|((stage, replica), report)| {
            let last = &report.last;
            wire::Stage {
                stage: stage.clone(),
                replica: *replica,
                generation: last.generation,
                state: state(last.state, silent_ns(report)),
                detail: last.detail.to_string(),
                taken_per_s: report.taken_per_s,
                published_per_s: report.published_per_s,
                dropped: last.dropped,
                failed: last.failed,
                queued: last.queued,
                processor: report.processor,
                resident_mb: last.resident_bytes as f32 * 1e-6,
                latency_ms: report.latency_ms,
            }
        });
        wire::Stages { stages: stages.collect() }
    }
}

fn state(code: u32, silent_ns: i64) -> &'static str {
    match StageState::try_from(code) {
        _ if silent_ns > SILENCE_NS => "silent",
        Ok(StageState::Starting) => "starting",
        Ok(StageState::Ready) => "ready",
        Ok(StageState::Draining) => "draining",
        Ok(StageState::Finished) => "finished",
        Ok(StageState::Degraded) => "degraded",
        Err(_) => "unknown",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
