//! Comparison of poses that were predicted for the time of sending with the truth at that time.

use std::collections::BTreeMap;

use flockeye_contract::TrackState;
use flockeye_tables::{PoseRow, PredictedPose, TruthRow};
use nalgebra::Isometry3;
use serde::Serialize;

use super::consistency::{Consistency, in_series};
use super::error::{ErrorSample, PoseOffset};
use super::path::TruePath;
use super::statistics::Spread;

/// Least time from exposure to prediction, seconds. In a lossless run predictions are for the
/// exposure itself.
const SHORTEST_S: f64 = 1e-4;

/// Errors of predictions for the time of sending.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Predictions {
    /// Errors of tracks that were measured in that frame; `None` if there are none.
    pub measured: Option<PredictionErrors>,
    /// Errors of tracks that were not measured; `None` if there are none.
    pub coasted: Option<PredictionErrors>,
}

/// Errors of predictions.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PredictionErrors {
    /// Number of predictions that were compared with the truth.
    pub compared: usize,
    /// Number of predictions without truth: it has no frames on both sides of their time.
    pub without_truth: usize,
    /// Time from exposure to prediction, milliseconds. This and the fields below are those of
    /// compared predictions.
    pub ahead_ms: Option<Spread>,
    /// Errors of the position, millimetres.
    pub position_mm: Option<Spread>,
    /// Errors of the orientation, degrees.
    pub rotation_deg: Option<Spread>,
    /// Errors of the position without a prediction, millimetres: the pose at the exposure is kept.
    pub held_position_mm: Option<Spread>,
    /// Errors of the orientation without a prediction, degrees.
    pub held_rotation_deg: Option<Spread>,
    /// Consistency of errors with their covariances.
    pub nees: Option<Consistency>,
}

impl Predictions {
    /// Compares the predictions of tracks with the truth at their times. `None` if no prediction is
    /// later than its exposure: in a lossless run, without a filter, or without recorded
    /// predictions.
    pub fn of(poses: &[PoseRow], truth: &[TruthRow]) -> Option<Self> {
        let mut bodies: BTreeMap<&str, Vec<&TruthRow>> = BTreeMap::new();
        truth.iter().for_each(|row| bodies.entry(row.body.as_str()).or_default().push(row));
        let paths: BTreeMap<&str, TruePath> =
            bodies.into_iter().map(|(body, rows)| (body, TruePath::of_body(rows))).collect();
        let (measured, coasted): (Vec<Ahead<'_>>, Vec<Ahead<'_>>) =
            poses.iter().filter_map(ahead).partition(|(pose, _)| pose.is_measured());
        let errors = |ahead| PredictionErrors::of(ahead, &paths);
        let found = Self { measured: errors(&measured), coasted: errors(&coasted) };
        (found.measured.is_some() || found.coasted.is_some()).then_some(found)
    }
}

impl PredictionErrors {
    fn of(ahead: &[Ahead<'_>], paths: &BTreeMap<&str, TruePath>) -> Option<Self> {
        if ahead.is_empty() {
            return None;
        }
        let (mut ahead_s, mut predicted, mut held) = (Vec::new(), Vec::new(), Vec::new());
        let mut samples: BTreeMap<&str, BTreeMap<u64, ErrorSample>> = BTreeMap::new();
        for (pose, prediction) in ahead {
            let after_s = prediction.at_s - pose.stamp_s;
            let path = paths.get(pose.target.as_str());
            let Some(then) = path.and_then(|path| path.pose(pose.frame, after_s)) else {
                continue;
            };
            let error = offset(&prediction.position, &prediction.orientation, &then);
            ahead_s.push(after_s);
            predicted.push(error);
            held.push(offset(&pose.position, &pose.orientation, &then));
            // The last of several poses of a frame is used.
            let of_body = samples.entry(&pose.target).or_default();
            of_body.insert(pose.frame, (error, prediction.covariance));
        }
        let spread = |errors: &[PoseOffset], size: fn(&PoseOffset) -> f64, unit: f64| {
            Spread::of(errors.iter().map(|error| size(error) * unit))
        };
        let series: Vec<Vec<ErrorSample>> = samples.into_values().flat_map(in_series).collect();
        Some(Self {
            compared: predicted.len(),
            without_truth: ahead.len() - predicted.len(),
            ahead_ms: Spread::of(ahead_s.iter().map(|ahead_s| ahead_s * 1e3)),
            position_mm: spread(&predicted, PoseOffset::position_m, 1e3),
            rotation_deg: spread(&predicted, PoseOffset::rotation_deg, 1.0),
            held_position_mm: spread(&held, PoseOffset::position_m, 1e3),
            held_rotation_deg: spread(&held, PoseOffset::rotation_deg, 1.0),
            nees: Consistency::of(&series),
        })
    }
}

/// A pose with its prediction for a later time than its exposure.
type Ahead<'a> = (&'a PoseRow, &'a PredictedPose);

fn ahead(pose: &PoseRow) -> Option<Ahead<'_>> {
    let is_track = !matches!(pose.state, TrackState::Lost | TrackState::Measured);
    let prediction = pose.predicted.as_ref().filter(|_| is_track)?;
    (prediction.at_s - pose.stamp_s > SHORTEST_S).then_some((pose, prediction))
}

fn offset(
    position: &nalgebra::Vector3<f64>,
    orientation: &nalgebra::UnitQuaternion<f64>,
    truth: &Isometry3<f64>,
) -> PoseOffset {
    PoseOffset::between(position, orientation, &truth.translation.vector, &truth.rotation)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::samples::{pose_at, truth_at};
    use nalgebra::{Matrix6, Vector3};

    /// A body that flies along y by 0.3 m a second, of which each pose is right but for 1 mm.
    fn flight(ahead_s: f64) -> (Vec<PoseRow>, Vec<TruthRow>) {
        let there = |at_s: f64| Vector3::new(1.0, 0.3 * at_s, 0.0);
        let truth = (0..10).map(|frame| truth_at(frame, there(frame as f64 / 30.0))).collect();
        let pose = |frame: u64| {
            let row = pose_at(frame, there(frame as f64 / 30.0), TrackState::Confirmed);
            let predicted = PredictedPose {
                at_s: row.stamp_s + ahead_s,
                position: there(row.stamp_s + ahead_s) + Vector3::new(0.0, 0.0, 1e-3),
                orientation: row.orientation,
                covariance: Matrix6::identity() * 1e-6,
            };
            PoseRow { predicted: Some(predicted), ..row }
        };
        ((0..10).map(pose).collect(), truth)
    }

    #[test]
    fn predictions_are_compared_with_the_truth_of_then() {
        let (poses, truth) = flight(0.05);
        let found = Predictions::of(&poses, &truth).expect("they reach ahead");
        assert_eq!(found.coasted, None);
        let found = found.measured.expect("all were measured");
        // The last two frames have no truth behind them.
        assert_eq!((found.compared, found.without_truth), (8, 2));
        let close = |found: Option<Spread>, median: f64| {
            let median_found = found.expect("there are some").median;
            assert!((median_found - median).abs() < 1e-3, "{median_found} is not {median}");
        };
        close(found.ahead_ms, 50.0);
        close(found.position_mm, 1.0);
        // Without prediction it would be 0.3 m/s times 50 ms.
        close(found.held_position_mm, 15.0);
        close(found.rotation_deg, 0.0);
        let nees = found.nees.expect("there are covariances").position;
        assert!((nees.mean - 1.0).abs() < 1e-3 && nees.inside_99 == 1.0, "{nees:?}");
    }

    #[test]
    fn those_of_frames_that_were_not_measured_are_judged_apart() {
        let (mut poses, truth) = flight(0.05);
        poses[3] = PoseRow {
            predicted: poses[3].predicted,
            ..pose_at(3, Vector3::x(), TrackState::Coasting)
        };
        let found = Predictions::of(&poses, &truth).expect("they reach ahead");
        let count = |errors: Option<PredictionErrors>| errors.map(|errors| errors.compared);
        assert_eq!((count(found.measured), count(found.coasted)), (Some(7), Some(1)));
    }

    #[test]
    fn what_does_not_reach_ahead_is_not_judged() {
        let (poses, truth) = flight(0.0);
        assert_eq!(Predictions::of(&poses, &truth), None);
        let (mut poses, truth) = flight(0.05);
        poses.iter_mut().for_each(|pose| pose.state = TrackState::Lost);
        assert_eq!(Predictions::of(&poses, &truth), None);
    }
}
