//! The dashboard as one serializable value, for programs.

use flockeye_contract::MeasuredBy;
use flockeye_runtime::health_rates::HealthRates;
use flockeye_tables::sweep::SweepReport;
use serde::Serialize;
use serde_json::{Value, json};

use super::{Dashboard, age_ms, deviation_m};

/// The pipeline at one moment.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct DashboardReport {
    /// Frames that ended since watching began.
    pub frames: u64,
    /// Frames that the source sent meanwhile and that were skipped.
    pub skipped: u64,
    /// Search rate of each part of the sphere since then. None where nothing is swept.
    pub sphere: Option<SweepReport>,
    /// Each process, by stage and number.
    pub stages: Vec<Value>,
    /// Each neighbour that was seen since then, by name.
    pub neighbours: Vec<NeighbourReport>,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct NeighbourReport {
    pub name: String,
    pub state: &'static str,
    /// Source of its measurement in the last frame: nothing, decoded or aligned.
    pub measured_by: &'static str,
    /// Position in the observer's frame, metres.
    pub position_m: [f64; 3],
    /// Root of the position covariance's trace, metres.
    pub deviation_m: f64,
    /// Age of the exposure of its last measurement, milliseconds.
    pub age_ms: f64,
    /// Markers decoded in its last frame.
    pub markers: u32,
    /// Latency of its last pose in each stage, milliseconds; null where it is unknown.
    pub latency_ms: Value,
    /// Distance from the true position, metres, where the source provides it.
    pub error_m: Option<f64>,
}

impl Dashboard {
    pub(crate) fn report(&self, now_ns: i64) -> DashboardReport {
        let stages = self
            .stages
            .iter()
            .map(|((stage, replica), rates)| stage_report(stage, *replica, rates, now_ns));
        let neighbours = self.neighbours.iter().filter_map(|(name, neighbour)| {
            let (track, arrived_ns) = neighbour.last.as_ref()?;
            let latency = &track.latency;
            Some(NeighbourReport {
                name: name.clone(),
                state: track.state_name(),
                measured_by: MeasuredBy::try_from(track.measured_by)
                    .map_or("unknown", MeasuredBy::name),
                position_m: track.observer_from_target.position,
                deviation_m: deviation_m(track),
                age_ms: age_ms(track, *arrived_ns, now_ns),
                markers: track.markers,
                latency_ms: json!({
                    "capture": milliseconds(latency.capture_ns),
                    "rectification": milliseconds(latency.rectification_ns),
                    "detection": milliseconds(latency.detection_ns),
                    "fusion": milliseconds(latency.fusion_ns),
                    "total": milliseconds(latency.total_ns),
                }),
                error_m: neighbour.error_m,
            })
        });
        DashboardReport {
            frames: self.frames_ended,
            skipped: self.frames_skipped,
            sphere: self.sphere,
            stages: stages.collect(),
            neighbours: neighbours.collect(),
        }
    }
}

/// One process: rates, totals, latency since its last report (null without work), and machine load.
fn stage_report(stage: &str, replica: u32, rates: &HealthRates, now_ns: i64) -> Value {
    let last = &rates.last;
    json!({
        "stage": stage,
        "replica": replica,
        "pid": last.pid,
        "generation": last.generation,
        "state": rates.state(now_ns),
        "detail": last.detail.to_string(),
        "taken_per_s": rates.taken_per_s,
        "published_per_s": rates.published_per_s,
        "latency_median_ms": rates.latency_ms.map(|[median, _]| median),
        "latency_p99_ms": rates.latency_ms.map(|[_, p99]| p99),
        "queued": last.queued,
        "dropped": last.dropped,
        "failed": last.failed,
        "processor_share": rates.processor_share,
        "resident_mb": last.resident_bytes as f64 / 1e6,
    })
}

fn milliseconds(ns: i64) -> Option<f64> {
    (ns >= 0).then_some(ns as f64 * 1e-6)
}
