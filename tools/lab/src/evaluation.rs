//! Poses against the truth: how many of the localisable bodies were measured, how well, how soon,
//! and whether errors are as large as they say.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`error`] | how far a pose is from the truth |
//! | [`statistics`] | means, quantiles, correlated samples |
//! | [`consistency`] | errors against their covariances |

pub mod consistency;
pub mod error;
pub mod statistics;
mod text;

use std::collections::BTreeMap;

use anyhow::ensure;
use flockeye_contract::{MeasuredBy, TrackState};
use nalgebra::Matrix6;
use serde::Serialize;

use crate::cli::Eval;
use crate::record::{self, PoseRow, TruthRow};
use crate::report;
use crate::screen::Screen;
use consistency::{Consistency, in_series};
use error::{Errors, PoseError};
use statistics::{median, quantile};

/// Ranges of distance, metres; then the range of the paper, the one beyond it, and everything.
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

/// A measurement that is wrong by more than this is a false one, metres.
pub const FALSE_M: f64 = 0.1;
/// The same of its rotation, degrees.
pub const FALSE_DEG: f64 = 10.0;

/// What came out in one range of distances.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Bin {
    /// From this distance, metres.
    pub from_m: f64,
    /// To this distance, metres; `None` to any.
    pub to_m: Option<f64>,
    /// Bodies with two or more markers wholly visible and localisable.
    pub eligible: usize,
    /// Those that were measured in that frame.
    pub measured: usize,
    /// Errors of the poses published for them; `None` if there are none.
    pub published: Option<Errors>,
    /// Errors of the frames' own measurements; `None` if there are none, or none was recorded.
    pub measurement: Option<Errors>,
}

/// What measurements rest on.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Sources {
    /// Decoded markers.
    pub decoded: usize,
    /// The body aligned with the image.
    pub aligned: usize,
}

/// Poses that were predicted only.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Coasted {
    /// How many.
    pub count: usize,
    /// Their errors, where the body is there; `None` if it never is.
    pub errors: Option<Errors>,
}

/// A measurement that is no measurement of its body.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FalsePose {
    /// The frame.
    pub frame: u64,
    /// Whose pose it should be.
    pub target: String,
    /// How far off it is, metres; `None`: the body is not there.
    pub position_m: Option<f64>,
    /// How far it is turned, degrees.
    pub rotation_deg: Option<f64>,
}

/// Exposure (in a lossless run: frame published) to pose published, milliseconds, of measured poses.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Latency {
    /// Half are sooner.
    pub median_ms: f64,
    /// 95 % are sooner.
    pub p95_ms: f64,
    /// 99 % are sooner.
    pub p99_ms: f64,
}

/// Whether covariances are right; `None` where there are none.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Covariances {
    /// Those of the frames' own measurements.
    pub measurements: Option<Consistency>,
    /// Those of the tracks, in frames that were measured.
    pub tracks: Option<Consistency>,
    /// Those of the tracks, in frames that were not.
    pub coasted: Option<Consistency>,
}

/// What came out.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Evaluation {
    /// By distance; the last is everything.
    pub bins: Vec<Bin>,
    /// Measured poses, eligible or not.
    pub measured: usize,
    /// What they rest on.
    pub sources: Sources,
    /// Poses that were predicted only.
    pub coasted: Coasted,
    /// Measurements that are wrong by more than 10 cm or 10 degrees, or of a body that is not there.
    pub false_poses: usize,
    /// Where they are.
    pub false_at: Vec<FalsePose>,
    /// How late poses are; `None` if there are none.
    pub latency: Option<Latency>,
    /// Whether errors are as large as they say.
    pub nees: Covariances,
}

/// Frames and bodies, in their order.
type Key<'a> = (&'a str, u64);

fn by_key<'a>(poses: Vec<&'a PoseRow>) -> BTreeMap<Key<'a>, &'a PoseRow> {
    poses.into_iter().map(|pose| ((pose.target.as_str(), pose.frame), pose)).collect()
}

impl Evaluation {
    /// Compares poses with the truth, row by row of frame and body.
    pub fn of(poses: &[PoseRow], truth: &[TruthRow]) -> Self {
        let truths: BTreeMap<Key<'_>, &TruthRow> =
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
        let known = |(key, pose): (&Key<'_>, &&PoseRow)| Some(published(pose, truths.get(key)?));
        let coasted: Vec<_> = predicted.iter().filter_map(known).collect();
        Self {
            bins,
            measured: measured.len(),
            sources: Sources {
                decoded: count(MeasuredBy::Decoded),
                aligned: count(MeasuredBy::Aligned),
            },
            coasted: Coasted { count: predicted.len(), errors: Errors::of(&coasted) },
            false_poses: false_at.len(),
            false_at,
            latency: Latency::of(&latencies),
            nees: Covariances {
                measurements: Consistency::of(&series(&measured, &truths, of_measurement)),
                tracks: Consistency::of(&series(&measured, &truths, of_track)),
                coasted: Consistency::of(&series(&predicted, &truths, of_track)),
            },
        }
    }

    /// Everything within 1.5 m, the paper's range.
    pub fn within_1_5_m(&self) -> Option<&Bin> {
        self.between(0.0, 1.5)
    }

    /// Everything between two distances, metres; `None` if there is no such bin.
    pub fn between(&self, from_m: f64, to_m: f64) -> Option<&Bin> {
        self.bins.iter().find(|bin| (bin.from_m, bin.to_m) == (from_m, Some(to_m)))
    }

    /// Everything.
    pub fn everything(&self) -> Option<&Bin> {
        self.bins.iter().find(|bin| bin.to_m.is_none())
    }
}

impl Bin {
    fn of(
        (from_m, to_m): (f64, Option<f64>),
        measured: &BTreeMap<Key<'_>, &PoseRow>,
        truths: &BTreeMap<Key<'_>, &TruthRow>,
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

    /// The share of the eligible that was measured; `None` if nobody is.
    pub fn share(&self) -> Option<f64> {
        (self.eligible > 0).then(|| self.measured as f64 / self.eligible as f64)
    }
}

impl FalsePose {
    /// Judges the frame's own measurement, where it was recorded, else the pose published for it.
    fn of(pose: &PoseRow, truth: Option<&TruthRow>) -> Option<Self> {
        let error =
            truth.map(|truth| measurement(pose, truth).unwrap_or_else(|| published(pose, truth)));
        let is_right =
            |error: &PoseError| error.position_m() <= FALSE_M && error.rotation_deg() <= FALSE_DEG;
        (!error.as_ref().is_some_and(is_right)).then(|| Self {
            frame: pose.frame,
            target: pose.target.clone(),
            position_m: error.as_ref().map(PoseError::position_m),
            rotation_deg: error.as_ref().map(PoseError::rotation_deg),
        })
    }
}

impl Latency {
    fn of(rising_ms: &[f64]) -> Option<Self> {
        Some(Self {
            median_ms: median(rising_ms)?,
            p95_ms: quantile(rising_ms, 0.95)?,
            p99_ms: quantile(rising_ms, 0.99)?,
        })
    }
}

/// Whether a body can be asked for: localisable, with two markers wholly visible.
pub fn is_eligible(truth: &TruthRow) -> bool {
    truth.localisable == 1 && truth.n_markers_vis90 >= 2
}

/// The error of the published pose.
pub fn published(pose: &PoseRow, truth: &TruthRow) -> PoseError {
    PoseError::of(&pose.position, &pose.orientation, truth)
}

/// The error of the frame's own measurement, where it was recorded.
pub fn measurement(pose: &PoseRow, truth: &TruthRow) -> Option<PoseError> {
    let measured = pose.measured.as_ref()?;
    Some(PoseError::of(&measured.position, &measured.orientation, truth))
}

/// An error with its covariance.
type Sample = (PoseError, Matrix6<f64>);

/// Of the frame's own measurement.
pub fn of_measurement(pose: &PoseRow, truth: &TruthRow) -> Option<Sample> {
    Some((measurement(pose, truth)?, pose.measured.as_ref()?.covariance?))
}

/// Of the track, where there is a filter.
pub fn of_track(pose: &PoseRow, truth: &TruthRow) -> Option<Sample> {
    let has_filter = pose.state != TrackState::Measured;
    Some((published(pose, truth), pose.covariance.filter(|_| has_filter)?))
}

/// Samples of each body, in series of neighbouring frames.
fn series(
    poses: &BTreeMap<Key<'_>, &PoseRow>,
    truths: &BTreeMap<Key<'_>, &TruthRow>,
    sample: fn(&PoseRow, &TruthRow) -> Option<Sample>,
) -> Vec<Vec<Sample>> {
    let mut bodies: BTreeMap<&str, Vec<(u64, Sample)>> = BTreeMap::new();
    for (key, pose) in poses {
        if let Some(sample) = truths.get(key).and_then(|truth| sample(pose, truth)) {
            bodies.entry(key.0).or_default().push((key.1, sample));
        }
    }
    bodies.into_values().flat_map(in_series).collect()
}

/// `flockeye eval`.
///
/// # Errors
/// A file cannot be read or is not as it should be, the two have nothing to do with each other, or
/// the report cannot be written.
pub fn run(arguments: &Eval) -> anyhow::Result<()> {
    let poses: Vec<PoseRow> = record::read(&arguments.poses)?;
    let truth: Vec<TruthRow> = record::read(&arguments.truth)?;
    let [poses_file, truth_file] = [&arguments.poses, &arguments.truth].map(|path| path.display());
    ensure!(
        !truth.is_empty(),
        "{truth_file} says nothing of any frame: there is nothing to compare with. Cure: give the \
         truth of the same flight; only a simulated one writes it (flockeye up --truth), a camera \
         or a recording has none of its own"
    );
    let frames = |numbers: Vec<u64>| {
        let (first, last) = (numbers.iter().min(), numbers.iter().max());
        format!("{} to {}", first.unwrap_or(&0), last.unwrap_or(&0))
    };
    let known: std::collections::BTreeSet<u64> = truth.iter().map(|row| row.frame).collect();
    ensure!(
        poses.is_empty() || poses.iter().any(|pose| known.contains(&pose.frame)),
        "{poses_file} (frames {}) and {truth_file} (frames {}) share no frame. Cure: give poses \
         and truth of the same flight",
        frames(poses.iter().map(|pose| pose.frame).collect()),
        frames(truth.iter().map(|row| row.frame).collect()),
    );
    let evaluation = Evaluation::of(&poses, &truth);
    let mut screen = Screen::new();
    if arguments.json {
        screen.line(&serde_json::to_string(&evaluation)?);
    } else {
        screen.line(&evaluation.to_string());
    }
    if let Some(folder) = &arguments.report {
        let source = format!("{poses_file} against {truth_file}");
        let file = report::write(folder, &source, &evaluation, &poses, &truth)?;
        if !arguments.json {
            screen.line(&format!("the report is {}", file.display()));
        }
    }
    Ok(())
}

#[cfg(test)]
pub(crate) mod samples {
    //! Rows for tests.

    use super::*;
    use crate::record::MeasuredPose;
    use nalgebra::{UnitQuaternion, Vector3};

    /// A pose of alpha, upright.
    pub(crate) fn pose_at(frame: u64, position: Vector3<f64>, state: TrackState) -> PoseRow {
        let orientation = UnitQuaternion::identity();
        let is_measured = !matches!(state, TrackState::Coasting | TrackState::Lost);
        let covariance = Some(Matrix6::identity() * 1e-4);
        PoseRow {
            frame,
            stamp_s: frame as f64 / 30.0,
            target: "alpha".into(),
            position,
            orientation,
            state,
            markers: 2,
            measured_by: if is_measured { MeasuredBy::Decoded } else { MeasuredBy::Nothing },
            measured: is_measured.then_some(MeasuredPose { position, orientation, covariance }),
            covariance,
            latency_ms: frame as f64,
        }
    }

    /// The truth of alpha, upright, with three markers to be seen.
    pub(crate) fn truth_at(frame: u64, position: Vector3<f64>) -> TruthRow {
        TruthRow {
            frame,
            t_s: frame as f64 / 30.0,
            body: "alpha".into(),
            x: position.x,
            y: position.y,
            z: position.z,
            qw: 1.0,
            qx: 0.0,
            qy: 0.0,
            qz: 0.0,
            dist_m: position.norm(),
            az_deg: 0.0,
            el_deg: 0.0,
            n_markers_vis50: 3,
            n_markers_vis90: 3,
            best_side_px: 20.0,
            blur_px: 0.0,
            env: "test".into(),
            observer_yaw_deg: 0.0,
            ev: 0.0,
            iso: 0,
            exposure_s: 0.0,
            localisable: 1,
        }
    }
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
        // A deviation of 1 cm: 1 and 9, and 4 where it was predicted.
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
