//! What is shown, for programs: one serializable value.

use flockeye_contract::{MeasuredBy, StageState, Track};
use serde::Serialize;

use super::{Dashboard, SILENCE_NS};
use crate::sweep::SweepReport;

/// The pipeline at one moment.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Report {
    /// Frames that came to their end since one looks.
    pub frames: u64,
    /// Frames that the source sent meanwhile and nobody worked on.
    pub skipped: u64,
    /// How often each part of the sphere was searched since one looks; none where it is not swept.
    pub sphere: Option<SweepReport>,
    /// Each process, by stage and number.
    pub stages: Vec<StageReport>,
    /// Each neighbour that was seen since one looks, by name.
    pub neighbours: Vec<NeighbourReport>,
}

/// One process.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StageReport {
    /// Its stage.
    pub stage: String,
    /// Which of its workers, from 0.
    pub replica: u32,
    /// Its process.
    pub pid: u32,
    /// How often it was replaced.
    pub generation: u32,
    /// starting, ready, degraded, draining, finished, or silent if it has not said anything for long.
    pub state: String,
    /// What it works with.
    pub detail: String,
    /// Messages taken in each second.
    pub taken_per_s: f64,
    /// Messages given out each second.
    pub published_per_s: f64,
    /// Latency of its work since its last report; none where it did nothing.
    pub latency_median_ms: Option<f64>,
    /// The same: 99 % quantile.
    pub latency_p99_ms: Option<f64>,
    /// What it has taken in or given out and is not done with.
    pub queued: u64,
    /// Messages that newer ones overtook, since it started.
    pub dropped: u64,
    /// Messages that were refused or could not be worked on, since it started.
    pub failed: u64,
    /// Share of one processor.
    pub processor_share: f64,
    /// Resident memory, shared memory included, MB.
    pub resident_mb: f64,
}

/// One neighbour.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct NeighbourReport {
    /// Its name.
    pub name: String,
    /// State of its track.
    pub state: String,
    /// What its last frame measured it by: nothing, decoded or aligned.
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
pub struct LatencyReport {
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
    /// What is shown now.
    pub fn report(&self, now_ns: i64) -> Report {
        let stages = self.stages.iter().map(|((stage, replica), view)| StageReport {
            stage: stage.clone(),
            replica: *replica,
            pid: view.last.pid,
            generation: view.last.generation,
            state: state_name(view.last.state, now_ns - view.last.sent_ns),
            detail: view.last.detail.to_string(),
            taken_per_s: view.taken_per_s,
            published_per_s: view.published_per_s,
            latency_median_ms: milliseconds(view.latency_median_ns),
            latency_p99_ms: milliseconds(view.latency_p99_ns),
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
                state: super::state_name(track.state),
                measured_by: MeasuredBy::try_from(track.measured_by)
                    .map_or("unknown".to_owned(), |by| format!("{by:?}").to_lowercase()),
                position_m: track.observer_from_target.position,
                deviation_m: super::deviation_m(track),
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
        Report {
            frames: self.frames_ended,
            skipped: self.frames_skipped,
            sphere: self.sphere,
            stages: stages.collect(),
            neighbours: neighbours.collect(),
        }
    }
}

/// Age of the light that a pose was last measured by, milliseconds.
pub(super) fn age_ms(track: &Track, arrived_ns: i64, now_ns: i64) -> f64 {
    (now_ns - arrived_ns + track.latency.total_ns + track.unseen_ns) as f64 * 1e-6
}

/// A stage's state in words.
pub(super) fn state_name(code: u32, silent_ns: i64) -> String {
    match StageState::try_from(code) {
        _ if silent_ns > SILENCE_NS => "silent".to_owned(),
        Ok(state) => format!("{state:?}").to_lowercase(),
        Err(_) => "unknown".to_owned(),
    }
}

fn milliseconds(ns: i64) -> Option<f64> {
    (ns >= 0).then_some(ns as f64 * 1e-6)
}
