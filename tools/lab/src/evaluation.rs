//! Comparison of poses with the truth: share of measured bodies, errors, latency, and consistency
//! of the covariances.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`error`] | errors of poses |
//! | [`statistics`] | means, quantiles, correlated samples |
//! | [`consistency`] | errors against their covariances |
//! | [`path`] | the truth at times between frames |
//! | [`predictions`] | poses predicted for the time of sending |
//! | [`rotations`] | the camera's own rotation |

pub mod consistency;
pub mod error;
pub mod path;
pub mod predictions;
pub mod rotations;
#[cfg(test)]
pub(crate) mod samples;
pub mod statistics;
mod text;

use std::collections::BTreeMap;

use flockeye_contract::{MeasuredBy, TrackState};
use flockeye_geometry::pose::{FALSE_POSITION_M, FALSE_ROTATION_RAD};
use flockeye_geometry::statistics::{median, quantile};
use flockeye_tables::{PoseRow, TruthRow};
use serde::Serialize;

use consistency::{Consistency, in_series};
use error::{ErrorSample, Errors, PoseOffset};
use predictions::Predictions;

/// Ranges of distance, metres. The last three are the paper's range, the range beyond it, and all
/// distances.
const RANGES_M: [(f64, Option<f64>); 8] = [
    (0.0, Some(1.0)),
    (1.0, Some(1.5)),
    (1.5, Some(2.2)),
    (2.2, Some(3.0)),
    (3.0, Some(4.0)),
    (0.0, Some(1.5)),
    (1.5, Some(2.4)),
    (0.0, None),
];

/// The results in one range of distances.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Bin {
    /// Least distance, metres.
    pub from_m: f64,
    /// Largest distance, metres; `None`: any distance.
    pub to_m: Option<f64>,
    /// Bodies with two or more markers wholly visible and localisable.
    pub eligible: usize,
    /// Eligible bodies that were measured in their frame.
    pub measured: usize,
    /// Errors of the poses published for them; `None` if there are none.
    pub published: Option<Errors>,
    /// Errors of the frames' own measurements; `None` if none was recorded.
    pub measurement: Option<Errors>,
}

/// Numbers of measurements by their method.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Sources {
    /// Measured by decoded markers.
    pub decoded: usize,
    /// Measured by alignment of the body's model with the image.
    pub aligned: usize,
}

/// Poses that were only predicted.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Coasted {
    /// Number of poses.
    pub count: usize,
    /// Errors of the poses; `None` if the truth contains none of them.
    pub errors: Option<Errors>,
}

/// A measurement with a large error, or of a body that is not in view.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FalsePose {
    /// Number of the frame.
    pub frame: u64,
    /// The body that was reported.
    pub target: String,
    /// Position error, metres; `None`: the body is not in the truth.
    pub position_m: Option<f64>,
    /// Rotation error, degrees.
    pub rotation_deg: Option<f64>,
}

/// Latency of measured poses, milliseconds: from exposure (in a lossless run: from the frame's
/// publication) to the pose's publication.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct LatencyQuantiles {
    /// Median.
    pub median_ms: f64,
    /// 95 % quantile.
    pub p95_ms: f64,
    /// 99 % quantile.
    pub p99_ms: f64,
}

/// Consistency of the covariances; `None` without covariances.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Covariances {
    /// Consistency of the frames' own measurements.
    pub measurements: Option<Consistency>,
    /// Consistency of tracks in frames that were measured.
    pub tracks: Option<Consistency>,
    /// Consistency of tracks in frames that were not measured.
    pub coasted: Option<Consistency>,
}

/// The results.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Evaluation {
    /// Results by distance. The last bin contains all distances.
    pub bins: Vec<Bin>,
    /// Measured poses, eligible or not.
    pub measured: usize,
    /// Numbers of measured poses by method.
    pub sources: Sources,
    /// Poses that were only predicted.
    pub coasted: Coasted,
    /// Poses predicted for the time of sending; `None` if none is later than its exposure.
    pub predictions: Option<Predictions>,
    /// Number of measurements with an error over 10 cm or 10 degrees, or of a body that is not in
    /// view.
    pub false_poses: usize,
    /// Frames and errors of the false poses.
    pub false_at: Vec<FalsePose>,
    /// The latency of measured poses; `None` if there are none.
    pub latency: Option<LatencyQuantiles>,
    /// Consistency of errors with their covariances.
    pub nees: Covariances,
}

/// A body and a frame.
type BodyFrame<'a> = (&'a str, u64);

fn by_key<'a>(poses: Vec<&'a PoseRow>) -> BTreeMap<BodyFrame<'a>, &'a PoseRow> {
    poses.into_iter().map(|pose| ((pose.target.as_str(), pose.frame), pose)).collect()
}

impl Evaluation {
    /// Compares poses with the truth of the same frame and body.
    pub fn of(poses: &[PoseRow], truth: &[TruthRow]) -> Self {
        let truths: BTreeMap<BodyFrame<'_>, &TruthRow> =
            truth.iter().map(|row| ((row.body.as_str(), row.frame), row)).collect();
        let (measured, predicted): (Vec<_>, Vec<_>) =
            poses.iter().partition(|pose| pose.is_measured());
        let (measured, predicted) = (by_key(measured), by_key(predicted));
        let bins = RANGES_M.map(|range| Bin::of(range, &measured, &truths)).into();
        let count = |by| measured.values().filter(|pose| pose.measured_by == by).count();
        let false_at: Vec<FalsePose> = measured
            .iter()
            .filter_map(|(key, pose)| FalsePose::of(pose, truths.get(key).copied()))
            .collect();
        let mut latencies: Vec<f64> = measured.values().map(|pose| pose.latency_ms).collect();
        latencies.sort_by(f64::total_cmp);
        let known =
            |(key, pose): (&BodyFrame<'_>, &&PoseRow)| Some(published(pose, truths.get(key)?));
        let coasted: Vec<_> = predicted.iter().filter_map(known).collect();
        Self {
            bins,
            measured: measured.len(),
            sources: Sources {
                decoded: count(MeasuredBy::Decoded),
                aligned: count(MeasuredBy::Aligned),
            },
            coasted: Coasted { count: predicted.len(), errors: Errors::of(&coasted) },
            predictions: Predictions::of(poses, truth),
            false_poses: false_at.len(),
            false_at,
            latency: LatencyQuantiles::of(&latencies),
            nees: Covariances {
                measurements: Consistency::of(&series(&measured, &truths, measurement_sample)),
                tracks: Consistency::of(&series(&measured, &truths, track_sample)),
                coasted: Consistency::of(&series(&predicted, &truths, track_sample)),
            },
        }
    }

    /// The bin within 1.5 m, the paper's range.
    pub fn within_1_5_m(&self) -> Option<&Bin> {
        self.between(0.0, 1.5)
    }

    /// The bin between two distances, metres; `None` if there is no such bin.
    pub fn between(&self, from_m: f64, to_m: f64) -> Option<&Bin> {
        self.bins.iter().find(|bin| (bin.from_m, bin.to_m) == (from_m, Some(to_m)))
    }

    /// The bin of all distances.
    pub fn everything(&self) -> Option<&Bin> {
        self.bins.iter().find(|bin| bin.to_m.is_none())
    }
}

impl Bin {
    fn of(
        (from_m, to_m): (f64, Option<f64>),
        measured: &BTreeMap<BodyFrame<'_>, &PoseRow>,
        truths: &BTreeMap<BodyFrame<'_>, &TruthRow>,
    ) -> Self {
        let inside = |row: &TruthRow| row.dist_m >= from_m && to_m.is_none_or(|to| row.dist_m < to);
        let eligible: Vec<_> =
            truths.iter().filter(|(_, row)| is_eligible(row) && inside(row)).collect();
        let found: Vec<(&PoseRow, &TruthRow)> =
            eligible.iter().filter_map(|(key, row)| Some((*measured.get(*key)?, **row))).collect();
        let of_poses: Vec<_> = found.iter().map(|(pose, row)| published(pose, row)).collect();
        let of_frames: Vec<_> =
            found.iter().filter_map(|(pose, row)| measurement(pose, row)).collect();
        Self {
            from_m,
            to_m,
            eligible: eligible.len(),
            measured: found.len(),
            published: Errors::of(&of_poses),
            measurement: Errors::of(&of_frames),
        }
    }

    /// The measured share of the eligible bodies; `None` without eligible bodies.
    pub fn share(&self) -> Option<f64> {
        (self.eligible > 0).then(|| self.measured as f64 / self.eligible as f64)
    }
}

impl FalsePose {
    /// Checks the frame's own measurement if it was recorded, else the published pose. `None` if
    /// the pose is correct.
    fn of(pose: &PoseRow, truth: Option<&TruthRow>) -> Option<Self> {
        let error =
            truth.map(|truth| measurement(pose, truth).unwrap_or_else(|| published(pose, truth)));
        let is_right = |error: &PoseOffset| {
            error.position_m() <= FALSE_POSITION_M && error.rotation.norm() <= FALSE_ROTATION_RAD
        };
        (!error.as_ref().is_some_and(is_right)).then(|| Self {
            frame: pose.frame,
            target: pose.target.clone(),
            position_m: error.as_ref().map(PoseOffset::position_m),
            rotation_deg: error.as_ref().map(PoseOffset::rotation_deg),
        })
    }
}

impl LatencyQuantiles {
    fn of(rising_ms: &[f64]) -> Option<Self> {
        Some(Self {
            median_ms: median(rising_ms)?,
            p95_ms: quantile(rising_ms, 0.95)?,
            p99_ms: quantile(rising_ms, 0.99)?,
        })
    }
}

/// Whether a body counts as eligible: localisable, with two markers wholly visible.
pub fn is_eligible(truth: &TruthRow) -> bool {
    truth.localisable == 1 && truth.n_markers_vis90 >= 2
}

/// The error of the published pose.
pub fn published(pose: &PoseRow, truth: &TruthRow) -> PoseOffset {
    PoseOffset::of(&pose.position, &pose.orientation, truth)
}

/// The error of the frame's own measurement, where it was recorded.
pub fn measurement(pose: &PoseRow, truth: &TruthRow) -> Option<PoseOffset> {
    let measured = pose.measured.as_ref()?;
    Some(PoseOffset::of(&measured.position, &measured.orientation, truth))
}

/// The error and the covariance of the frame's own measurement.
pub fn measurement_sample(pose: &PoseRow, truth: &TruthRow) -> Option<ErrorSample> {
    Some((measurement(pose, truth)?, pose.measured.as_ref()?.covariance?))
}

/// The error and the covariance of the track. `None` without a filter.
pub fn track_sample(pose: &PoseRow, truth: &TruthRow) -> Option<ErrorSample> {
    let has_filter = pose.state != TrackState::Measured;
    Some((published(pose, truth), pose.covariance.filter(|_| has_filter)?))
}

/// The samples of each body, cut into series of consecutive frames.
fn series(
    poses: &BTreeMap<BodyFrame<'_>, &PoseRow>,
    truths: &BTreeMap<BodyFrame<'_>, &TruthRow>,
    sample: fn(&PoseRow, &TruthRow) -> Option<ErrorSample>,
) -> Vec<Vec<ErrorSample>> {
    let mut bodies: BTreeMap<&str, Vec<(u64, ErrorSample)>> = BTreeMap::new();
    for (key, pose) in poses {
        if let Some(sample) = truths.get(key).and_then(|truth| sample(pose, truth)) {
            bodies.entry(key.0).or_default().push((key.1, sample));
        }
    }
    bodies.into_values().flat_map(in_series).collect()
}

#[cfg(test)]
mod tests {
    use super::samples::{pose_at, truth_at};
    use super::*;
    use nalgebra::{UnitQuaternion, Vector3};

    fn pose(frame: u64, x: f64, state: TrackState) -> PoseRow {
        pose_at(frame, Vector3::new(x, 0.0, 0.0), state)
    }

    fn truth(frame: u64, x: f64, visible: u32) -> TruthRow {
        TruthRow { n_markers_vis90: visible, ..truth_at(frame, Vector3::new(x, 0.0, 0.0)) }
    }

    #[test]
    fn only_measured_poses_of_eligible_bodies_count() {
        let poses = [
            pose(0, 1.001, TrackState::Confirmed),
            pose(1, 1.204, TrackState::Coasting),
            pose(2, 1.52, TrackState::Confirmed),
            pose(3, 1.0, TrackState::Measured),
            pose(5, 2.0, TrackState::Confirmed),
        ];
        let truths = [
            truth(0, 1.0, 3),
            truth(1, 1.2, 2),
            truth(2, 1.4, 1),
            truth(4, 0.5, 2),
            truth(5, 2.05, 2),
        ];
        let evaluation = Evaluation::of(&poses, &truths);
        let near = evaluation.within_1_5_m().expect("there is such a bin");
        assert_eq!((near.eligible, near.measured, near.share()), (3, 1, Some(1.0 / 3.0)));
        let errors = near.published.expect("one");
        assert!((errors.position_mm.median - 1.0).abs() < 1e-9);
        assert_eq!(near.measurement, near.published);
        let all = evaluation.everything().expect("there is such a bin");
        assert_eq!((all.eligible, all.measured), (4, 2));
        assert!((all.published.expect("two").along_bias_mm + 24.5).abs() < 1e-9);
        assert_eq!((evaluation.measured, evaluation.coasted.count), (4, 1));
        assert_eq!(evaluation.sources, Sources { decoded: 4, aligned: 0 });
        let coasted = evaluation.coasted.errors.expect("it is there");
        assert!((coasted.position_mm.mean - 4.0).abs() < 1e-9);
        // Frame 2 is 12 cm off, in frame 3 nobody is there.
        let places: Vec<_> =
            evaluation.false_at.iter().map(|at| (at.frame, at.position_m)).collect();
        assert_eq!(places.len(), 2);
        assert!(places[0].0 == 2 && places[1] == (3, None), "{places:?}");
        // Latencies of frames 0, 2, 3 and 5.
        let latency = evaluation.latency.expect("four");
        assert_eq!((latency.median_ms, latency.p99_ms), (2.5, 5.0));
    }

    #[test]
    fn turned_measurements_are_false_even_if_the_track_is_not() {
        let mut turned = pose(0, 1.0, TrackState::Confirmed);
        let measured = turned.measured.as_mut().expect("it was measured");
        measured.orientation = UnitQuaternion::from_euler_angles(0.0, 0.2, 0.0);
        let evaluation = Evaluation::of(&[turned], &[truth(0, 1.0, 2)]);
        assert_eq!(evaluation.false_poses, 1);
        assert!((evaluation.false_at[0].rotation_deg.expect("there") - 11.459).abs() < 1e-3);
        let near = evaluation.within_1_5_m().expect("there is such a bin");
        assert!(near.published.expect("one").rotation_deg.worst < 1e-6);
    }

    #[test]
    fn consistency_is_of_measurements_tracks_and_predictions() {
        let poses = [
            pose(0, 1.01, TrackState::Confirmed),
            pose(1, 1.03, TrackState::Confirmed),
            pose(2, 1.02, TrackState::Coasting),
        ];
        let truths = [truth(0, 1.0, 2), truth(1, 1.0, 2), truth(2, 1.0, 2)];
        let nees = Evaluation::of(&poses, &truths).nees;
        // A standard deviation of 1 cm: 1 and 9, and 4 where it was predicted.
        let tracks = nees.tracks.expect("two");
        assert!((tracks.position.mean - 5.0).abs() < 1e-9 && tracks.position.samples == 2);
        assert_eq!(nees.measurements, nees.tracks);
        assert!((nees.coasted.expect("one").position.mean - 4.0).abs() < 1e-9);
        // Without a filter there is no track.
        let alone = [pose(0, 1.01, TrackState::Measured)];
        let nees = Evaluation::of(&alone, &truths).nees;
        assert!(nees.tracks.is_none() && nees.measurements.is_some());
    }
}
