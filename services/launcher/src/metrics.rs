//! Metrics of a run for Prometheus (`metrics.listen` in pipeline.yaml): counters, gauges,
//! latencies, liveness and readiness.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`snapshot`] | metrics of one moment |
//! | [`endpoint`] | answers requests |

pub(crate) mod endpoint;
pub(crate) mod snapshot;

use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use anyhow::Context;
use flockeye_contract::Track;
use flockeye_runtime::lock::lock;
use prometheus_client::encoding::text::encode;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::histogram::Histogram;
use prometheus_client::registry::{Registry, Unit};

use crate::dashboard::Dashboard;
use endpoint::MetricsPage;
use snapshot::{Labels, LatestMetrics, metrics_of};

/// Update period of the metrics.
const PERIOD: Duration = Duration::from_secs(1);

/// Upper bounds of the latencies' bins, seconds: from a fast stage to a pose that is useless by its
/// age.
const LATENCY_BOUNDS_S: [f64; 14] = [
    0.001, 0.002, 0.004, 0.006, 0.010, 0.015, 0.020, 0.033, 0.050, 0.075, 0.100, 0.200, 0.500, 1.0,
];

fn latencies() -> Histogram {
    Histogram::new(LATENCY_BOUNDS_S)
}

type Latencies = Family<Labels, Histogram, fn() -> Histogram>;

/// Exporter of a run's metrics.
pub(crate) struct MetricsExporter {
    registry: Registry,
    latencies: Latencies,
    latest: LatestMetrics,
    /// Frames that had ended when the metrics were last brought up to date.
    frames_ended: u64,
    page: Arc<Mutex<MetricsPage>>,
    next: Instant,
}

impl MetricsExporter {
    /// Serves the metrics at this address.
    pub(crate) fn serve(listen: SocketAddr, instance: &str) -> anyhow::Result<Self> {
        let metrics = Self::new(instance);
        endpoint::start(listen, metrics.page.clone()).with_context(|| {
            format!("metrics.listen {listen} cannot be listened on. Cure: another port")
        })?;
        Ok(metrics)
    }

    fn new(instance: &str) -> Self {
        let labels = [("instance_name".into(), instance.to_owned().into())];
        let mut registry = Registry::with_prefix_and_labels("flockeye", labels.into_iter());
        let latencies: Latencies = Family::new_with_constructor(latencies);
        registry.register_with_unit(
            "pose_latency",
            "Time of a measured pose in each stage, and from exposure to pose (part=total)",
            Unit::Seconds,
            latencies.clone(),
        );
        let latest = LatestMetrics::default();
        registry.register_collector(Box::new(latest.clone()));
        let now = Instant::now();
        let page = MetricsPage { text: String::new(), written: now, last_frame: None };
        let page = Arc::new(Mutex::new(page));
        Self { registry, latencies, latest, frames_ended: 0, page, next: now }
    }

    /// Takes the tracks of a frame.
    pub(crate) fn tracks(&self, tracks: &[Track]) {
        for track in tracks.iter().filter(|track| track.unseen_ns == 0) {
            let latency = &track.latency;
            let parts = [
                ("capture", latency.capture_ns),
                ("rectification", latency.rectification_ns),
                ("detection", latency.detection_ns),
                ("fusion", latency.fusion_ns),
                ("total", latency.total_ns),
            ];
            for (part, ns) in parts.into_iter().filter(|(_, ns)| *ns >= 0) {
                let labels = vec![("part", part.to_owned())];
                self.latencies.get_or_create(&labels).observe(ns as f64 * 1e-9);
            }
        }
    }

    /// Updates the metrics, if the period has passed.
    pub(crate) fn update(&mut self, dashboard: &Dashboard, now_ns: i64) {
        let now = Instant::now();
        if now < self.next {
            return;
        }
        self.next = now + PERIOD;
        *lock(&self.latest.0) = metrics_of(dashboard, now_ns);
        let frames_before = std::mem::replace(&mut self.frames_ended, dashboard.frames_ended);
        let has_gone_on = self.frames_ended > frames_before;
        let mut text = String::new();
        if let Err(error) = encode(&mut text, &self.registry) {
            tracing::debug!("metrics cannot be written: {error}");
            return;
        }
        let mut page = lock(&self.page);
        let last_frame = if has_gone_on { Some(now) } else { page.last_frame };
        *page = MetricsPage { text, written: now, last_frame };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockeye_contract::{FrameStamp, Health, StageLatency, StageState};

    #[test]
    fn what_happened_is_in_the_text() {
        let mut metrics = MetricsExporter::new("field");
        let mut dashboard = Dashboard::default();
        dashboard.health(&Health {
            stage: "detection".into(),
            replica: 1,
            generation: 3,
            taken: 70,
            dropped: 2,
            processor_ns: 1_500_000_000,
            state: StageState::Ready.code(),
            ..Health::default()
        });
        let latency = StageLatency {
            capture_ns: -1,
            detection_ns: 5_000_000,
            total_ns: 30_000_000,
            ..StageLatency::default()
        };
        let track = Track { name: "alpha".into(), latency, ..bytemuck::Zeroable::zeroed() };
        dashboard.tracks(&FrameStamp::default(), &[track], true, 0);
        metrics.tracks(&[track]);
        metrics.update(&dashboard, 0);
        let page = lock(&metrics.page).clone();
        assert!(page.last_frame.is_some());
        for line in [
            r#"flockeye_stage_taken_total{instance_name="field",stage="detection",worker="1"} 70"#,
            r#"flockeye_stage_dropped_total{instance_name="field",stage="detection",worker="1"} 2"#,
            r#"flockeye_stage_restarts_total{instance_name="field",stage="detection",worker="1"} 3"#,
            r#"flockeye_stage_processor_seconds_total{instance_name="field",stage="detection",worker="1"} 1.5"#,
            r#"flockeye_frames_total{instance_name="field"} 1"#,
            r#"flockeye_pose_latency_seconds_bucket{instance_name="field",le="0.033",part="total"} 1"#,
            r#"flockeye_pose_latency_seconds_bucket{instance_name="field",le="0.02",part="total"} 0"#,
        ] {
            assert!(page.text.contains(line), "{line} is missing:\n{}", page.text);
        }
        assert!(!page.text.contains("part=\"capture\""), "an unknown latency is none");
    }
}
