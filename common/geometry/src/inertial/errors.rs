//! Bias, mounting and time offset of an inertial sensor, by comparison with the picture.
//!
//! The camera's angular velocity is w(t) = exp(m) w_s(t - o) - b. Here w_s is the sensor's rate in
//! its configured mounting, m the mounting's error as a rotation vector, o the time offset, and b
//! the bias. The mean rate from the picture between two frames measures all seven numbers. A Kalman
//! filter estimates them (Mirzaei and Roumeliotis, IEEE Trans. Robotics 24, 2008; for the offset Li
//! and Mourikis, IJRR 33, 2014).

use nalgebra::{Matrix3, SMatrix, SVector, UnitQuaternion, Vector3};

use super::record::RateRecord;
use crate::ego_rotation::Turned;

/// Initial standard deviations: bias of a sensor of this class (rad/s: 3 degrees/s), mounting by
/// hand or by calibration (2 degrees), time offset (10 ms).
const FIRST_BIAS: f64 = 0.052;
const FIRST_MOUNTING: f64 = 0.035;
const FIRST_OFFSET_S: f64 = 0.01;

/// Random walk of the bias: 0.05 degrees/s in a second, 0.4 in a minute.
const BIAS_WALK: f64 = 8.7e-4;

/// Random walk of the time offset: 0.2 ms in a second. An autopilot's clock is mapped by the least
/// delay of the last seconds, which steps by fractions of a millisecond.
const OFFSET_WALK: f64 = 2e-4;

/// Scale and cross-axis errors, as a share of the rate. Data sheets of such sensors state 0.5 % and
/// 1 % at most.
const SCALE_ERROR: f64 = 0.003;

/// Bias, rotation vector of the mounting, and time offset.
pub type Vector7 = SVector<f64, 7>;
/// Covariance of a [`Vector7`].
pub type Matrix7 = SMatrix<f64, 7, 7>;
/// Derivative of a rotation vector by a [`Vector7`].
pub type Matrix3x7 = SMatrix<f64, 3, 7>;

/// Errors of a sensor, with their covariance.
#[derive(Debug, Clone, PartialEq)]
pub struct SensorErrors {
    /// Bias of the rate, along the camera's axes, rad/s.
    pub bias: Vector3<f64>,
    /// Rotates the configured sensor's axes into the true ones.
    mounting: UnitQuaternion<f64>,
    /// Offset to add to the sensor's time, seconds.
    offset_s: f64,
    /// Covariance of bias, rotation vector of the mounting, and time offset.
    covariance: Matrix7,
}

/// A rotation from the sensor, corrected for its errors.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Corrected {
    /// The camera's rotation between the two times.
    pub turned: Turned,
    /// Variance from the samples' noise and scale about each axis, rad^2.
    rest_variance: f64,
    /// Derivative of the rotation vector by the errors.
    by_errors: Matrix3x7,
}

impl SensorErrors {
    /// Creates the errors before any comparison.
    #[expect(clippy::new_without_default, reason = "the first errors are no plain zeros")]
    pub fn new() -> Self {
        let deviations = [FIRST_BIAS, FIRST_MOUNTING, FIRST_OFFSET_S];
        let variances = Vector7::from_fn(|k, _| deviations[k / 3].powi(2));
        Self {
            bias: Vector3::zeros(),
            mounting: UnitQuaternion::identity(),
            offset_s: 0.0,
            covariance: Matrix7::from_diagonal(&variances),
        }
    }

    /// Handles a new start of the sensor's clock: the offset is as uncertain as at first.
    pub fn begin_clock(&mut self) {
        self.covariance.row_mut(6).fill(0.0);
        self.covariance.column_mut(6).fill(0.0);
        self.covariance[(6, 6)] = FIRST_OFFSET_S * FIRST_OFFSET_S;
    }

    /// The camera's time at a time of the sensor, seconds.
    pub fn camera_time_s(&self, sensor_s: f64) -> f64 {
        sensor_s + self.offset_s
    }

    /// Rotation of the camera between two of its times, corrected for the sensor's errors. `None`
    /// where samples are missing.
    pub fn turned(&self, record: &RateRecord, earlier_s: f64, later_s: f64) -> Option<Corrected> {
        let correct = |rate: Vector3<f64>| self.mounting * rate - self.bias;
        let (from_s, to_s) = (earlier_s - self.offset_s, later_s - self.offset_s);
        let (later_from_earlier, noise_variance) = record.turned(from_s, to_s, correct)?;
        let step_s = later_s - earlier_s;
        let change = record.rate_at(to_s)? - record.rate_at(from_s)?;
        let vector = -later_from_earlier.scaled_axis();
        let by_errors = by_errors(&vector, step_s, &(self.mounting * change));
        let rest_variance = noise_variance + (SCALE_ERROR * vector.norm()).powi(2);
        let covariance = by_errors * self.covariance * by_errors.transpose()
            + Matrix3::from_diagonal_element(rest_variance);
        let turned = Turned { later_from_earlier, covariance };
        Some(Corrected { turned, rest_variance, by_errors })
    }

    /// The camera's angular velocity, averaged over `width_s` round a time, rad/s, with its
    /// covariance.
    pub fn rate(
        &self,
        record: &RateRecord,
        at_s: f64,
        width_s: f64,
    ) -> Option<(Vector3<f64>, Matrix3<f64>)> {
        let (rate, noise_variance) = record.rate_around(at_s - self.offset_s, width_s)?;
        let turned = self.mounting * rate;
        let scale = (SCALE_ERROR * turned.norm()).powi(2);
        // The uncertainty of the time offset is left out, because the picture soon determines it to
        // a millisecond.
        let by_errors = by_errors(&turned, 1.0, &Vector3::zeros());
        let covariance = by_errors * self.covariance * by_errors.transpose()
            + Matrix3::from_diagonal_element(noise_variance + scale);
        Some((turned - self.bias, covariance))
    }

    /// Updates the errors with the picture's rotation over `step_s` seconds and the sensor's,
    /// `corrected`.
    pub fn compare(&mut self, corrected: &Corrected, picture: &Turned, step_s: f64) {
        let walk = BIAS_WALK * BIAS_WALK * step_s;
        (0..3).for_each(|k| self.covariance[(k, k)] += walk);
        self.covariance[(6, 6)] += OFFSET_WALK * OFFSET_WALK * step_s;
        let seen = &corrected.by_errors;
        let noise = picture.covariance + Matrix3::from_diagonal_element(corrected.rest_variance);
        let spread = seen * self.covariance * seen.transpose() + noise;
        let Some(spread) = spread.cholesky() else { return };
        let gain = self.covariance * seen.transpose() * spread.inverse();
        let change = gain * corrected.off(picture);
        let kept = Matrix7::identity() - gain * seen;
        // Joseph's form stays symmetric and positive.
        self.covariance =
            kept * self.covariance * kept.transpose() + gain * noise * gain.transpose();
        self.apply(&change);
    }

    /// Adds a step of bias, mounting and offset to the errors.
    pub(super) fn apply(&mut self, change: &Vector7) {
        self.bias += change.fixed_rows::<3>(0);
        let turned: Vector3<f64> = change.fixed_rows::<3>(3).into();
        self.mounting = UnitQuaternion::from_scaled_axis(turned) * self.mounting;
        self.offset_s += change[6];
    }
}

impl Corrected {
    /// The camera's rotation vector from the picture, less that from the sensor, radians.
    pub fn off(&self, picture: &Turned) -> Vector3<f64> {
        self.turned.later_from_earlier.scaled_axis() - picture.later_from_earlier.scaled_axis()
    }

    /// Squared Mahalanobis distance between sensor and picture: chi-square with 3 degrees of
    /// freedom if both are right. `None` where a matrix is no covariance.
    pub fn distance(&self, picture: &Turned) -> Option<f64> {
        let off = self.off(picture);
        let spread = (self.turned.covariance + picture.covariance).cholesky()?;
        Some(off.dot(&spread.solve(&off)))
    }

    /// Rotation from both, weighted by their covariances. `None` where a matrix is no covariance.
    pub fn with(&self, picture: &Turned) -> Option<Turned> {
        let sensor = &self.turned;
        let spread = (sensor.covariance + picture.covariance).cholesky()?;
        // Directions rotate opposite to the camera.
        let camera = -sensor.later_from_earlier.scaled_axis()
            + sensor.covariance * spread.solve(&self.off(picture));
        let covariance = sensor.covariance * spread.solve(&picture.covariance);
        Some(Turned {
            later_from_earlier: UnitQuaternion::from_scaled_axis(-camera),
            covariance: (covariance + covariance.transpose()) / 2.0,
        })
    }
}

/// Derivative of a sensor's rotation vector by bias, mounting and time offset: `turned` over
/// `step_s`, with `change` of the rate meanwhile.
pub fn by_errors(turned: &Vector3<f64>, step_s: f64, change: &Vector3<f64>) -> Matrix3x7 {
    let mut by_errors = Matrix3x7::zeros();
    by_errors.fixed_view_mut::<3, 3>(0, 0).copy_from(&Matrix3::from_diagonal_element(-step_s));
    by_errors.fixed_view_mut::<3, 3>(0, 3).copy_from(&-turned.cross_matrix());
    by_errors.fixed_view_mut::<3, 1>(0, 6).copy_from(&-change);
    by_errors
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::fixtures::flight::{flown, rate};
    use crate::inertial::record::RateSample;

    /// Rotation vector of a sensor with these errors.
    fn record(bias: Vector3<f64>, mounting: Vector3<f64>, offset_s: f64) -> RateRecord {
        let mut record = RateRecord::new(100.0);
        let turned = UnitQuaternion::from_scaled_axis(mounting).inverse();
        for k in 0..1400u32 {
            let at_s = f64::from(k) / 200.0;
            record.push(RateSample { at_s, rate: turned * (rate(at_s + offset_s) + bias) });
        }
        record
    }

    fn picture(k: u32) -> (f64, f64, Turned) {
        let (earlier_s, later_s) = (f64::from(k) / 30.0, f64::from(k + 1) / 30.0);
        let later_from_earlier = flown(later_s).inverse() * flown(earlier_s);
        let covariance = Matrix3::from_diagonal_element(5e-4f64.powi(2));
        (earlier_s, later_s, Turned { later_from_earlier, covariance })
    }

    #[test]
    fn bias_mounting_and_offset_are_found() {
        let bias = Vector3::new(0.01, -0.02, 0.008);
        let mounting = Vector3::new(0.02, -0.03, 0.015);
        let record = record(bias, mounting, 0.007);
        let mut errors = SensorErrors::new();
        for k in 2..200 {
            let (earlier_s, later_s, seen) = picture(k);
            let corrected = errors.turned(&record, earlier_s, later_s).unwrap();
            let distance = corrected.distance(&seen).unwrap();
            assert!(distance < 16.0, "frame {k}: {distance}");
            errors.compare(&corrected, &seen, later_s - earlier_s);
        }
        assert!((errors.bias - bias).norm() < 0.002, "{}", errors.bias);
        let off = errors.mounting.scaled_axis() - mounting;
        assert!(off.norm() < 0.004, "{off}");
        assert!((errors.offset_s - 0.007).abs() < 0.001, "{}", errors.offset_s);
        let (earlier_s, later_s, seen) = picture(202);
        let corrected = errors.turned(&record, earlier_s, later_s).unwrap();
        let off = corrected.off(&seen).norm();
        assert!(off < 1e-4 && off < 4.0 * corrected.turned.covariance.trace().sqrt(), "{off}");
        let (found, deviations) = errors.rate(&record, 4.0, 0.01).unwrap();
        let off = found - rate(4.0);
        assert!(off.norm() < 0.006 && off.norm() < 4.0 * deviations.trace().sqrt(), "{off}");
    }

    #[test]
    fn an_upside_down_sensor_and_a_clock_half_a_second_off_are_far_from_the_picture() {
        let upside_down = Vector3::new(std::f64::consts::PI, 0.0, 0.0);
        for record in [
            record(Vector3::zeros(), upside_down, 0.0),
            record(Vector3::zeros(), Vector3::zeros(), 0.5),
        ] {
            let mut errors = SensorErrors::new();
            let mut far = 0;
            for k in 2..60 {
                let (earlier_s, later_s, seen) = picture(k);
                let corrected = errors.turned(&record, earlier_s, later_s).unwrap();
                match corrected.distance(&seen).unwrap() {
                    distance if distance > 16.0 => far += 1,
                    _ => errors.compare(&corrected, &seen, later_s - earlier_s),
                }
            }
            assert!(far > 20, "{far} of 58");
        }
    }
}
