//! State of the stages and the neighbours, collected from health, tracks and truth.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`text`] | the dashboard as a table, as a line, and as a summary at the end |
//! | [`report`] | the dashboard as one value for programs |

pub(crate) mod report;
pub(crate) mod text;

use std::collections::{BTreeMap, VecDeque};

use flockeye_contract::{BodyTruth, FrameStamp, Health, StageState, Track, TruthHeader};
use flockeye_runtime::health_rates::HealthRates;
use flockeye_tables::sweep::SweepReport;
use nalgebra::Vector3;

/// Maximum number of frames whose truth is kept until their tracks arrive.
const TRUTH_FRAMES: usize = 256;

/// Current state of the stages, of the neighbours and of the search.
#[derive(Default)]
pub(crate) struct Dashboard {
    stages: BTreeMap<(String, u32), HealthRates>,
    neighbours: BTreeMap<String, NeighbourView>,
    truths: VecDeque<(FrameStamp, Vec<BodyTruth>)>,
    pub frames_ended: u64,
    /// Frames that the source sent and that no stage processed.
    pub frames_skipped: u64,
    last_frame: Option<FrameStamp>,
    has_truth: bool,
    /// Search rate of the sphere.
    pub sphere: Option<SweepReport>,
}

#[derive(Default)]
struct NeighbourView {
    last: Option<(Track, i64)>,
    /// Frame of `last`.
    stamp: Option<FrameStamp>,
    error_m: Option<f64>,
    measured: u64,
    unmeasured: u64,
    eligible: u64,
    eligible_measured: u64,
    /// Frames in which the neighbour was measured and that have not ended. Only ended frames count
    /// as localisable.
    open: Vec<FrameStamp>,
    errors_mm: VecDeque<f64>,
    latencies_ms: VecDeque<f64>,
}

/// Maximum number of samples: an hour of frames. A long flight must not fill the memory.
const MAX_SAMPLES: usize = 108_000;

fn add_sample(samples: &mut VecDeque<f64>, value: f64) {
    if samples.len() == MAX_SAMPLES {
        samples.pop_front();
    }
    samples.push_back(value);
}

impl Dashboard {
    /// Takes a health report of a stage.
    pub(crate) fn health(&mut self, health: &Health) {
        let key = (health.stage.to_string(), health.replica);
        let rates = self.stages.entry(key).or_insert_with(|| HealthRates::new(health));
        rates.take(health);
    }

    /// Last state that a stage reported, if any.
    pub(crate) fn state_of(&self, stage: &str, replica: u32) -> Option<StageState> {
        let view = self.stages.get(&(stage.to_owned(), replica))?;
        StageState::try_from(view.last.state).ok()
    }

    /// The last report of a process; `None` if it never sent one.
    pub(crate) fn last_report(&self, stage: &str, replica: u32, pid: u32) -> Option<&Health> {
        let view = self.stages.get(&(stage.to_owned(), replica))?;
        (view.last.pid == pid).then_some(&view.last)
    }

    /// Takes the truth of a frame.
    pub(crate) fn truth(&mut self, header: &TruthHeader, bodies: &[BodyTruth]) {
        self.has_truth = true;
        self.truths.push_back((header.stamp, bodies.to_vec()));
        if self.truths.len() > TRUTH_FRAMES {
            self.truths.pop_front();
        }
    }

    /// Takes the tracks of a frame.
    pub(crate) fn tracks(
        &mut self,
        stamp: &FrameStamp,
        tracks: &[Track],
        is_last: bool,
        now_ns: i64,
    ) {
        let truth = self.truths.iter().rev().find(|(of, _)| of.is_same_frame(stamp));
        for track in tracks {
            let name = track.name.to_string();
            let body =
                truth.and_then(|(_, bodies)| bodies.iter().find(|body| body.name == track.name));
            let neighbour = self.neighbours.entry(name).or_default();
            neighbour.error_m = body.map(|body| error_m(track, body));
            if track.is_measured() {
                // Another fusion may send several poses of a frame.
                let is_first = !neighbour.open.iter().any(|of| of.is_same_frame(stamp));
                neighbour.measured += u64::from(is_first);
                add_sample(&mut neighbour.latencies_ms, track.latency.total_ns as f64 * 1e-6);
                if let Some(error) = neighbour.error_m {
                    add_sample(&mut neighbour.errors_mm, error * 1e3);
                }
                neighbour.open.push(*stamp);
            } else {
                neighbour.unmeasured += 1;
            }
            if neighbour.stamp.is_none_or(|last| !stamp.is_late_beside(&last)) {
                neighbour.stamp = Some(*stamp);
                neighbour.last = Some((*track, now_ns));
            }
        }
        if is_last {
            self.frames_ended += 1;
            if let Some(last) = self.last_frame.replace(*stamp) {
                self.frames_skipped += stamp.skipped_since(&last);
            }
            for body in truth.map(|(_, bodies)| bodies.as_slice()).unwrap_or_default() {
                let neighbour = self.neighbours.entry(body.name.to_string()).or_default();
                if is_eligible(body) {
                    neighbour.eligible += 1;
                    let is_measured = neighbour.open.iter().any(|of| of.is_same_frame(stamp));
                    neighbour.eligible_measured += u64::from(is_measured);
                }
            }
            for neighbour in self.neighbours.values_mut() {
                // Frames end in order.
                neighbour.open.retain(|of| of.order() > stamp.order());
            }
        }
    }

    /// Each worker's stage, number and health rates.
    pub(crate) fn workers(&self) -> impl Iterator<Item = (&str, u32, &HealthRates)> {
        self.stages.iter().map(|((stage, worker), rates)| (stage.as_str(), *worker, rates))
    }
}

fn is_eligible(body: &BodyTruth) -> bool {
    body.localisable == 1 && body.markers_visible_90 >= 2
}

fn error_m(track: &Track, body: &BodyTruth) -> f64 {
    let difference = Vector3::from(track.observer_from_target.position)
        - Vector3::from(body.observer_from_target.position);
    difference.norm()
}

/// Root of the trace of the position covariance, metres.
fn deviation_m(track: &Track) -> f64 {
    (track.covariance[0] + track.covariance[7] + track.covariance[14]).max(0.0).sqrt()
}

/// Age of the exposure that a pose was last measured in, milliseconds.
fn age_ms(track: &Track, arrived_ns: i64, now_ns: i64) -> f64 {
    (now_ns - arrived_ns + track.latency.total_ns + track.unseen_ns) as f64 * 1e-6
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockeye_contract::{MeasuredBy, Pose, TrackState};

    #[test]
    fn measurements_in_frames_that_have_not_ended_are_not_counted() {
        let mut dashboard = Dashboard::default();
        let body = BodyTruth {
            name: "alpha".into(),
            observer_from_target: Pose::default(),
            localisable: 1,
            markers_visible_90: 2,
            ..BodyTruth::default()
        };
        let track = Track {
            name: "alpha".into(),
            state: TrackState::Confirmed.code(),
            measured_by: MeasuredBy::Aligned.code(),
            ..bytemuck::Zeroable::zeroed()
        };
        for sequence in 0..3 {
            let stamp = FrameStamp { sequence, ..FrameStamp::default() };
            dashboard.truth(&TruthHeader { stamp, ..TruthHeader::default() }, &[body]);
            // Twice, as when a better pose follows; the last frame does not end.
            dashboard.tracks(&stamp, &[track], false, 0);
            dashboard.tracks(&stamp, &[track], sequence < 2, 0);
        }
        let alpha = &dashboard.neighbours["alpha"];
        assert_eq!((alpha.eligible, alpha.eligible_measured), (2, 2));
        assert_eq!((alpha.measured, alpha.unmeasured), (3, 0));
        assert_eq!(alpha.open.len(), 2, "the frame that has not ended");
    }

    #[test]
    fn a_track_that_an_imprecise_pose_corrected_is_not_measured() {
        let mut dashboard = Dashboard::default();
        let track = Track {
            name: "alpha".into(),
            state: TrackState::Confirmed.code(),
            ..bytemuck::Zeroable::zeroed()
        };
        dashboard.tracks(&FrameStamp::default(), &[track], true, 0);
        let alpha = &dashboard.neighbours["alpha"];
        assert_eq!((alpha.measured, alpha.unmeasured), (0, 1));
        assert!(alpha.latencies_ms.is_empty());
    }
}
