//! Comparison of the camera's recorded rotation with its true attitude or a gyroscope.

use flockeye_geometry::inertial::RateRecord;
use flockeye_geometry::statistics::median;
use flockeye_tables::{ImuRow, RecordedTurn, RotationRow, TruthRow, rate_record};
use nalgebra::{UnitQuaternion, Vector3};
use serde::Serialize;

use super::consistency::{Nees, in_series, normalised};
use super::path::TruePath;
use super::statistics::Spread;

/// The reference for rotations.
#[derive(Debug, Clone)]
pub enum TrueRotation {
    /// The attitudes of a simulated flight.
    Attitudes(TruePath),
    /// A gyroscope's samples, and the bias that is subtracted from them, rad/s.
    Gyroscope(RateRecord, Vector3<f64>),
}

/// Errors of the camera's rotation.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct RotationEvaluation {
    /// Number of frames with a known rotation.
    pub known: usize,
    /// Number of frames with an unknown rotation, such as the first frame of a flight.
    pub not_known: usize,
    /// Number of compared rotations.
    pub compared: usize,
    /// Errors of the rotation from one frame to the next, degrees.
    pub error_deg: Option<Spread>,
    /// Median of the stated standard deviation (root of the covariance's trace), degrees.
    pub stated_deg: Option<f64>,
    /// Errors of the rate at the exposure, degrees/s.
    pub rate_error_deg_s: Option<Spread>,
    /// Median of the stated standard deviation of the rate, degrees/s.
    pub rate_stated_deg_s: Option<f64>,
    /// NEES of rotations.
    pub nees: Option<Nees>,
    /// NEES of rates.
    pub rate_nees: Option<Nees>,
    /// The gyroscope's constant bias, which was subtracted: the median difference from the recorded
    /// rotations, degrees/s.
    pub gyroscope_bias_deg_s: Option<f64>,
}

impl TrueRotation {
    /// The attitudes of the truth; `None` if it contains none.
    pub fn of_truth(truth: &[TruthRow]) -> Option<Self> {
        TruePath::of_camera(truth).map(Self::Attitudes)
    }

    /// The samples of a gyroscope whose axes are the camera's.
    pub fn of_gyroscope(rows: Vec<ImuRow>) -> Self {
        Self::Gyroscope(rate_record(rows), Vector3::zeros())
    }

    /// The true rotation of directions from the earlier exposure to the frame's exposure.
    fn turned(&self, row: &RotationRow, turn: &RecordedTurn) -> Option<UnitQuaternion<f64>> {
        match self {
            Self::Attitudes(path) => {
                let later = path.pose(row.frame, 0.0)?.rotation;
                let earlier = path.pose(row.frame, turn.earlier_s - row.stamp_s)?.rotation;
                Some(later.inverse() * earlier)
            }
            // After the last sample of the sensor there is no reference.
            Self::Gyroscope(record, _) if record.newest_s()? < row.stamp_s => None,
            Self::Gyroscope(record, bias) => {
                record.later_from_earlier(turn.earlier_s, row.stamp_s, |rate| rate - bias)
            }
        }
    }

    /// The rate at a frame's exposure, rad/s.
    fn rate(&self, row: &RotationRow) -> Option<Vector3<f64>> {
        match self {
            Self::Attitudes(path) => path.rate(row.frame),
            Self::Gyroscope(record, _) if record.newest_s()? < row.stamp_s => None,
            Self::Gyroscope(record, bias) => Some(record.rate_at(row.stamp_s)? - bias),
        }
    }

    /// The gyroscope's constant bias, rad/s: the median difference from the recorded rotations
    /// along each axis. The median is robust against single wrong rotations. `None` for attitudes.
    fn bias(&self, rows: &[RotationRow]) -> Option<Vector3<f64>> {
        let Self::Gyroscope(..) = self else { return None };
        let differences = rows.iter().filter_map(|row| {
            let turn = row.turn.as_ref()?;
            let off = turn.later_from_earlier.scaled_axis() - self.turned(row, turn)?.scaled_axis();
            let step_s = row.stamp_s - turn.earlier_s;
            (step_s > 0.0).then(|| off / step_s)
        });
        let differences: Vec<Vector3<f64>> = differences.collect();
        let along = |axis: usize| middle(differences.iter().map(|rate| rate[axis]).collect());
        Some(Vector3::new(along(0)?, along(1)?, along(2)?))
    }

    /// Returns the rotation without that bias.
    fn without(self, bias: Option<Vector3<f64>>) -> Self {
        match (self, bias) {
            (Self::Gyroscope(record, _), Some(bias)) => Self::Gyroscope(record, bias),
            (unbiased, _) => unbiased,
        }
    }
}

/// The median of values in any order.
fn middle(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    median(&values)
}

impl RotationEvaluation {
    /// Compares recorded rotations with the truth. A gyroscope's constant bias is subtracted; its
    /// noise is part of the errors.
    pub fn of(rows: &[RotationRow], truth: TrueRotation) -> Self {
        let bias = truth.bias(rows);
        let truth = truth.without(bias);
        let known = rows.iter().filter(|row| row.turn.is_some()).count();
        let (mut errors, mut stated, mut nees) = (Vec::new(), Vec::new(), Vec::new());
        let (mut rate_errors, mut rate_stated, mut rate_nees) =
            (Vec::new(), Vec::new(), Vec::new());
        for row in rows {
            let Some(turn) = &row.turn else { continue };
            if let Some(expected) = truth.turned(row, turn) {
                let off = (turn.later_from_earlier * expected.inverse()).scaled_axis();
                errors.push(off.norm().to_degrees());
                stated.push(turn.covariance.trace().max(0.0).sqrt().to_degrees());
                nees.extend(normalised(&off, &turn.covariance).map(|nees| (row.frame, nees)));
            }
            if let Some(expected) = truth.rate(row) {
                let off = turn.rate_in_camera - expected;
                rate_errors.push(off.norm().to_degrees());
                rate_stated.push(turn.rate_covariance.trace().max(0.0).sqrt().to_degrees());
                let normalised = normalised(&off, &turn.rate_covariance);
                rate_nees.extend(normalised.map(|nees| (row.frame, nees)));
            }
        }
        Self {
            known,
            not_known: rows.len() - known,
            compared: errors.len(),
            error_deg: Spread::of(errors),
            stated_deg: middle(stated),
            rate_error_deg_s: Spread::of(rate_errors),
            rate_stated_deg_s: middle(rate_stated),
            nees: Nees::of(&in_series(nees)),
            rate_nees: Nees::of(&in_series(rate_nees)),
            gyroscope_bias_deg_s: bias.map(|bias| bias.norm().to_degrees()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::samples::truth_at;
    use flockeye_contract::RotationSource;
    use nalgebra::Matrix3;

    const FRAMES: u64 = 30;
    const STEP_S: f64 = 1.0 / 30.0;
    /// Error of each recorded rotation, and stated standard deviation of each axis, radians.
    const OFF_RAD: f64 = 1e-3;

    /// The camera leans and yaws.
    fn world_from_camera(at_s: f64) -> UnitQuaternion<f64> {
        UnitQuaternion::from_euler_angles(0.2 * (3.0 * at_s).sin(), 0.1 * at_s, 0.8 * at_s)
    }

    fn rate(at_s: f64) -> Vector3<f64> {
        let step_s = 1e-5;
        let turned = world_from_camera(at_s - step_s).inverse() * world_from_camera(at_s + step_s);
        turned.scaled_axis() / (2.0 * step_s)
    }

    /// Rotations that are wrong by `OFF_RAD`, each about another axis, and rates by 0.01 rad/s; the
    /// first one is not known.
    fn rotations() -> Vec<RotationRow> {
        let row = |frame: u64| {
            let (earlier_s, stamp_s) = ((frame as f64 - 1.0) * STEP_S, frame as f64 * STEP_S);
            let truth = world_from_camera(stamp_s).inverse() * world_from_camera(earlier_s);
            // The golden angle's steps: on average the errors are none.
            let (sin, cos) = (frame as f64 * 2.399_963).sin_cos();
            let axis = Vector3::new(cos, sin, 0.0);
            let turn = RecordedTurn {
                source: RotationSource::Picture,
                earlier_s,
                earlier_exposure_s: earlier_s,
                later_from_earlier: UnitQuaternion::from_scaled_axis(axis * OFF_RAD) * truth,
                covariance: Matrix3::from_diagonal_element(OFF_RAD * OFF_RAD),
                rate_in_camera: rate(stamp_s) + axis * 0.01,
                rate_covariance: Matrix3::from_diagonal_element(0.02 * 0.02),
            };
            let turn = (frame > 0).then_some(turn);
            RotationRow { frame, stamp_s, exposure_s: stamp_s, turn }
        };
        (0..FRAMES).map(row).collect()
    }

    fn attitudes() -> TrueRotation {
        let rows: Vec<TruthRow> = (0..FRAMES)
            .map(|frame| {
                let turned = world_from_camera(frame as f64 * STEP_S);
                TruthRow {
                    camera_qw: Some(turned.w),
                    camera_qx: Some(turned.i),
                    camera_qy: Some(turned.j),
                    camera_qz: Some(turned.k),
                    ..truth_at(frame, Vector3::x())
                }
            })
            .collect();
        TrueRotation::of_truth(&rows).expect("it has attitudes")
    }

    /// 200 samples a second, with a bias.
    fn gyroscope(bias: Vector3<f64>) -> TrueRotation {
        TrueRotation::of_gyroscope(samples(bias))
    }

    fn samples(bias: Vector3<f64>) -> Vec<ImuRow> {
        let sample = |k: i32| {
            let t_s = f64::from(k) / 200.0;
            ImuRow { t_s, rate: rate(t_s) + bias, specific_force: None }
        };
        (-20..220).map(sample).collect()
    }

    fn assert_as_made(found: &RotationEvaluation, tolerance: f64) {
        assert_eq!((found.known, found.not_known), (29, 1));
        let close = |found: Option<f64>, wanted: f64| {
            let found = found.expect("there are some");
            assert!((found / wanted - 1.0).abs() < tolerance, "{found} is not {wanted}");
        };
        close(found.error_deg.map(|error| error.median), OFF_RAD.to_degrees());
        close(found.stated_deg, (3.0_f64.sqrt() * OFF_RAD).to_degrees());
        close(found.nees.map(|nees| nees.mean), 1.0);
        close(found.rate_error_deg_s.map(|error| error.median), 0.01_f64.to_degrees());
        close(found.rate_nees.map(|nees| nees.mean), 0.25);
    }

    #[test]
    fn rotations_are_compared_with_attitudes() {
        let found = RotationEvaluation::of(&rotations(), attitudes());
        assert_as_made(&found, 0.02);
        assert_eq!((found.compared, found.gyroscope_bias_deg_s), (29, None));
        // The first two and the last two frames do not have five around them; the first is not
        // known.
        assert_eq!(found.rate_nees.map(|nees| nees.samples), Some(26));
    }

    #[test]
    fn a_gyroscopes_bias_is_taken_out() {
        let bias = Vector3::new(0.01, -0.02, 0.005);
        let found = RotationEvaluation::of(&rotations(), gyroscope(bias));
        assert_as_made(&found, 0.06);
        let bias_deg_s = found.gyroscope_bias_deg_s.expect("it is a gyroscope");
        assert!((bias_deg_s - bias.norm().to_degrees()).abs() < 0.1, "{bias_deg_s}");
        assert_eq!(found.compared, 29);
    }

    #[test]
    fn what_the_truth_does_not_reach_is_not_compared() {
        let short =
            samples(Vector3::zeros()).into_iter().filter(|sample| sample.t_s < 0.5).collect();
        let found = RotationEvaluation::of(&rotations(), TrueRotation::of_gyroscope(short));
        assert_eq!((found.known, found.compared), (29, 14));
        let none = RotationEvaluation::of(&[], attitudes());
        assert_eq!((none.compared, none.error_deg, none.nees), (0, None, None));
    }
}
