//! The dashboard as one serializable value, for programs.

use flockeye_contract::MeasuredBy;
use flockeye_tables::sweep::SweepReport;
use serde::Serialize;

use super::{Dashboard, age_ms, deviation_m, track_state_name};

/// The pipeline at one moment.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct DashboardReport {
    /// Frames that ended since watching began.
    pub frames: u64,
    /// Frames that the source sent meanwhile and that were skipped.
    pub skipped: u64,
    /// How often each part of the sphere was searched since then. None where nothing is swept.
    pub sphere: Option<SweepReport>,
    /// Each process, by stage and number.
    pub stages: Vec<StageReport>,
    /// Each neighbour that was seen since then, by name.
    pub neighbours: Vec<NeighbourReport>,
}

/// One process.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct StageReport {
    /// Its stage.
    pub stage: String,
    /// Which of its workers, from 0.
    pub replica: u32,
    /// Its process.
    pub pid: u32,
    /// How often it was replaced.
    pub generation: u32,
    /// starting, ready, degraded, draining, finished, or silent if it has not reported for long.
    pub state: String,
    /// What it works with, in words.
    pub detail: String,
    /// Messages taken in each second.
    pub taken_per_s: f64,
    /// Messages given out each second.
    pub published_per_s: f64,
    /// Latency of its work since its last report; none where it did nothing.
    pub latency_median_ms: Option<f64>,
    /// 99 % quantile of the latency, milliseconds.
    pub latency_p99_ms: Option<f64>,
    /// Messages taken in or given out that are not finished.
    pub queued: u64,
    /// Messages replaced by newer ones, since it started.
    pub dropped: u64,
    /// Messages that were refused or could not be processed, since it started.
    pub failed: u64,
    /// Share of one processor.
    pub processor_share: f64,
    /// Resident memory, shared memory included, MB.
    pub resident_mb: f64,
}

/// One neighbour.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct NeighbourReport {
    /// Its name.
    pub name: String,
    /// State of its track.
    pub state: String,
    /// What its measurement in the last frame rests on: nothing, decoded or aligned.
    pub measured_by: String,
    /// Position in the observer's frame, metres.
    pub position_m: [f64; 3],
    /// Root of the position covariance's trace, metres.
    pub deviation_m: f64,
    /// Age of the light that its pose was last measured by, milliseconds.
    pub age_ms: f64,
    /// Markers decoded in its last frame.
    pub markers: u32,
    /// Where its last pose's time went, milliseconds.
    pub latency_ms: LatencyReport,
    /// Distance from the true position, metres, where the source knows it.
    pub error_m: Option<f64>,
}

/// Time from stage to stage, milliseconds; none where it is unknown.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub(crate) struct LatencyReport {
    /// Exposure to frame.
    pub capture: Option<f64>,
    /// Frame to view.
    pub rectification: Option<f64>,
    /// View to record.
    pub detection: Option<f64>,
    /// Record to pose.
    pub fusion: Option<f64>,
    /// Exposure to pose.
    pub total: Option<f64>,
}

impl Dashboard {
    /// The values now.
    pub(crate) fn report(&self, now_ns: i64) -> DashboardReport {
        let stages = self.stages.iter().map(|((stage, replica), view)| StageReport {
            stage: stage.clone(),
            replica: *replica,
            pid: view.last.pid,
            generation: view.last.generation,
            state: view.state(now_ns).to_owned(),
            detail: view.last.detail.to_string(),
            taken_per_s: view.taken_per_s,
            published_per_s: view.published_per_s,
            latency_median_ms: view.latency_ms.map(|[median, _]| median),
            latency_p99_ms: view.latency_ms.map(|[_, p99]| p99),
            queued: view.last.queued,
            dropped: view.last.dropped,
            failed: view.last.failed,
            processor_share: view.processor_share,
            resident_mb: view.last.resident_bytes as f64 / 1e6,
        });
        let neighbours = self.neighbours.iter().filter_map(|(name, neighbour)| {
            let (track, arrived_ns) = neighbour.last.as_ref()?;
            let latency = &track.latency;
            Some(NeighbourReport {
                name: name.clone(),
                state: track_state_name(track.state).to_owned(),
                measured_by: MeasuredBy::try_from(track.measured_by)
                    .map_or("unknown", MeasuredBy::name)
                    .to_owned(),
                position_m: track.observer_from_target.position,
                deviation_m: deviation_m(track),
                age_ms: age_ms(track, *arrived_ns, now_ns),
                markers: track.markers,
                latency_ms: LatencyReport {
                    capture: milliseconds(latency.capture_ns),
                    rectification: milliseconds(latency.rectification_ns),
                    detection: milliseconds(latency.detection_ns),
                    fusion: milliseconds(latency.fusion_ns),
                    total: milliseconds(latency.total_ns),
                },
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

fn milliseconds(ns: i64) -> Option<f64> {
    (ns >= 0).then_some(ns as f64 * 1e-6)
}
