//! The filter of one neighbour: its present and future pose.
//!
//! An error-state Kalman filter on position x rotation with constant velocity, driven by
//! white-noise acceleration (Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking
//! and Navigation", section 6.2.2; Sola, "Quaternion kinematics for the error-state Kalman
//! filter").
//!
//! The state is the pose of the markers in the camera frame with its linear and angular velocity;
//! the error is (position, rotation vector, linear velocity, angular velocity), all in the camera's
//! axes: `R_true = exp(rotation error) R`. So the leading 6x6 block is the project's pose
//! covariance.
//!
//! A turn of the camera is no acceleration of the neighbours. So velocities are relative to axes
//! that do not turn. Their components are along the camera's present axes. A step rotates the whole
//! state by the camera's own rotation ([`EgoRotation`]), and adds that rotation's covariance. Where
//! the rotation is not known, the camera counts as not turning, and velocities are relative to the
//! camera.

mod belief;
mod chi_square;
mod life;
mod saved;

pub use belief::{CONFIRM_WINDOW, GATE_PROBABILITY, STALE_AFTER_FRAMES};
pub use chi_square::{chi_square_gate, chi_square_quantile};
pub use life::{
    FrameMeasurement, HISTORY_S, Happened, LifeCycle, RivalPose, TrackPolicy, TrackState,
};
pub use saved::SavedLife;

use crate::ego_rotation::{EgoRotation, Turned};
use crate::pose::{PoseEstimate, pose_difference};
use nalgebra::{
    Isometry3, Matrix3, Matrix6, SMatrix, SVector, Translation3, UnitQuaternion, Vector3,
};
use serde::{Deserialize, Serialize};

/// Covariance of the error: position, rotation vector, linear and angular velocity.
pub type StateCovariance = SMatrix<f64, 12, 12>;

/// Motion model of a neighbour.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MotionModel {
    /// White-noise acceleration along each axis: root of its spectral density, m/s^2 per root Hz.
    /// It is also the standard deviation of a known velocity one second later, m/s.
    pub acceleration: f64,
    /// White-noise angular acceleration about each axis, rad/s^2 per root Hz.
    pub angular_acceleration: f64,
    /// Standard deviation of each component of a new track's velocity, m/s.
    pub initial_speed: f64,
    /// Standard deviation of each component of a new track's angular velocity, rad/s.
    pub initial_rate: f64,
    /// Longest prediction step, seconds. Longer steps are refused, because the result would be
    /// meaningless.
    pub longest_step_s: f64,
}

impl Default for MotionModel {
    /// For small drones that fly together: 0.7 m/s^2 and 3 rad/s^2 per root Hz, 2 m/s and 1.5 rad/s
    /// at first. A tenth of a second ahead that is 13 mm and 3 degrees along each axis. A constant
    /// 2.5 m/s^2 and 11 rad/s^2 have the same effect. A whole second ahead it is 0.4 m. Larger
    /// values smooth less of the measurement noise. Then a neighbour out of sight for some frames
    /// needs a view so wide that no marker decodes in it.
    fn default() -> Self {
        Self {
            acceleration: 0.7,
            angular_acceleration: 3.0,
            initial_speed: 2.0,
            initial_rate: 1.5,
            longest_step_s: 5.0,
        }
    }
}

/// Present or predicted pose of a neighbour, with its velocities.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MotionEstimate {
    /// Time of the state, seconds.
    pub stamp_s: f64,
    /// The pose of the body's markers in the camera frame.
    pub camera_from_markers: Isometry3<f64>,
    /// Velocity of the markers' origin in axes that do not turn, along those of the camera, m/s.
    pub velocity: Vector3<f64>,
    /// Angular velocity in axes that do not turn, along those of the camera, rad/s.
    pub rate: Vector3<f64>,
    /// The camera's own angular velocity, in its axes, rad/s. It follows from the camera's rotation
    /// at each prediction, so it is not saved.
    #[serde(skip)]
    pub camera_rate: Vector3<f64>,
    /// Covariance of the whole state; see [`StateCovariance`].
    pub covariance: StateCovariance,
}

impl MotionEstimate {
    /// Velocity relative to the turning camera, in which an object at rest moves, m/s.
    pub fn apparent_velocity(&self) -> Vector3<f64> {
        self.velocity - self.camera_rate.cross(&self.camera_from_markers.translation.vector)
    }

    /// The pose with its covariance.
    pub fn pose(&self) -> PoseEstimate {
        let camera_from_markers = self.camera_from_markers;
        PoseEstimate { camera_from_markers, covariance: self.pose_covariance() }
    }

    /// Covariance of the pose: position (m), then rotation vector (rad), in the camera's axes.
    pub fn pose_covariance(&self) -> Matrix6<f64> {
        self.covariance.fixed_view::<6, 6>(0, 0).into_owned()
    }

    /// Returns this state in the axes of a camera that has turned meanwhile.
    ///
    /// An error d of the camera's rotation causes the error d x v of a vector v, and the error d of
    /// the attitude.
    fn turned(self, turned: &Turned) -> Self {
        let camera = &turned.later_from_earlier;
        let camera_from_markers = Isometry3::from_parts(
            Translation3::from(camera * self.camera_from_markers.translation.vector),
            camera * self.camera_from_markers.rotation,
        );
        let (velocity, rate) = (camera * self.velocity, camera * self.rate);
        let matrix = camera.to_rotation_matrix().into_inner();
        let mut turn = StateCovariance::zeros();
        (0..12).step_by(3).for_each(|k| turn.fixed_view_mut::<3, 3>(k, k).copy_from(&matrix));
        let mut doubt = SMatrix::<f64, 12, 3>::zeros();
        let position = &camera_from_markers.translation.vector;
        for (row, vector) in [(0, position), (6, &velocity), (9, &rate)] {
            doubt.fixed_view_mut::<3, 3>(row, 0).copy_from(&-vector.cross_matrix());
        }
        doubt.fixed_view_mut::<3, 3>(3, 0).fill_diagonal(1.0);
        let covariance = turn * self.covariance * turn.transpose()
            + doubt * turned.covariance * doubt.transpose();
        Self { camera_from_markers, velocity, rate, covariance, ..self }
    }
}

/// Reason why the filter has no result.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say what the fields are")]
pub enum FilterError {
    /// A pose, a time or a covariance is not finite, or the matrix is no covariance.
    #[error("the {what} is not usable: it must be finite, a covariance also positive definite")]
    Unusable { what: &'static str },
    /// The time lies before the track's.
    #[error("{at_s:.6} s lies before the track's own time, {stamp_s:.6} s")]
    Past { at_s: f64, stamp_s: f64 },
    /// The time lies too far after the track's for a prediction.
    #[error(
        "{at_s:.6} s lies more than {longest_s} s after the track's time, {stamp_s:.6} s: start anew"
    )]
    Gap { at_s: f64, stamp_s: f64, longest_s: f64 },
    /// The measurement lies outside the gate; the track has not changed.
    #[error("the measurement lies outside the gate: {:.1} > {gate:.1}", .distance_squared)]
    Gated {
        /// Squared Mahalanobis distance: chi-square with 6 degrees of freedom if the model is
        /// right.
        distance_squared: f64,
        /// Log-likelihood of the measurement, up to a constant.
        log_likelihood: f64,
        gate: f64,
    },
}

impl MotionEstimate {
    /// Starts a track with a measured pose and unknown velocity.
    ///
    /// # Errors
    /// [`FilterError::Unusable`].
    pub fn start(
        stamp_s: f64,
        measured: &PoseEstimate,
        motion: &MotionModel,
    ) -> Result<Self, FilterError> {
        check(stamp_s, measured)?;
        let mut covariance = StateCovariance::zeros();
        covariance.fixed_view_mut::<6, 6>(0, 0).copy_from(&measured.covariance);
        for axis in 0..3 {
            covariance[(6 + axis, 6 + axis)] = motion.initial_speed.powi(2);
            covariance[(9 + axis, 9 + axis)] = motion.initial_rate.powi(2);
        }
        Ok(Self {
            stamp_s,
            camera_from_markers: measured.camera_from_markers,
            velocity: Vector3::zeros(),
            rate: Vector3::zeros(),
            camera_rate: Vector3::zeros(),
            covariance,
        })
    }

    /// Predicts the neighbour's state at `at_s` (seconds, on the clock of the measurements) with
    /// constant velocity, for a camera that turns by `ego`.
    ///
    /// # Errors
    /// A time before the track's, more than [`MotionModel::longest_step_s`] after it, or a time
    /// that is not finite.
    pub fn predict(
        &self,
        at_s: f64,
        motion: &MotionModel,
        ego: &EgoRotation,
    ) -> Result<Self, FilterError> {
        if !at_s.is_finite() {
            return Err(FilterError::Unusable { what: "time" });
        }
        let (stamp_s, longest_s) = (self.stamp_s, motion.longest_step_s);
        let step = at_s - stamp_s;
        if step < 0.0 {
            return Err(FilterError::Past { at_s, stamp_s });
        }
        if step > longest_s {
            return Err(FilterError::Gap { at_s, stamp_s, longest_s });
        }
        let turn = UnitQuaternion::from_scaled_axis(self.rate * step);
        let pose = &self.camera_from_markers;
        let camera_from_markers = Isometry3::from_parts(
            Translation3::from(pose.translation.vector + self.velocity * step),
            turn * pose.rotation,
        );
        // With R_true = exp(e) R and the rate w + d:
        // exp((w + d) t) exp(e) R = exp(Jl(w t) d t) exp(exp(w t) e) exp(w t) R, to first order.
        let mut transition = StateCovariance::identity();
        transition.fixed_view_mut::<3, 3>(0, 6).fill_diagonal(step);
        transition.fixed_view_mut::<3, 3>(3, 3).copy_from(turn.to_rotation_matrix().matrix());
        transition
            .fixed_view_mut::<3, 3>(3, 9)
            .copy_from(&(left_jacobian(&(self.rate * step)) * step));
        let covariance = transition * self.covariance * transition.transpose() + motion.noise(step);
        let moved = Self {
            stamp_s: at_s,
            camera_from_markers,
            velocity: self.velocity,
            rate: self.rate,
            camera_rate: ego.rate_at(at_s),
            covariance,
        };
        Ok(moved.turned(&ego.between(stamp_s, at_s)))
    }

    /// Adds a covariance to that of the pose.
    pub(super) fn loosen(&mut self, by: &Matrix6<f64>) {
        let mut of_pose = self.covariance.fixed_view_mut::<6, 6>(0, 0);
        of_pose += by;
    }

    /// Updates the state with a pose measured at `stamp_s` by a camera that turned by `ego`. A
    /// measurement outside `gate` is refused: the largest squared Mahalanobis distance to pass (see
    /// [`chi_square_gate`]). Returns the log-likelihood of the measurement, up to a constant.
    ///
    /// # Errors
    /// [`FilterError`]; the track is unchanged then.
    pub fn update(
        &mut self,
        stamp_s: f64,
        measured: &PoseEstimate,
        gate: f64,
        motion: &MotionModel,
        ego: &EgoRotation,
    ) -> Result<f64, FilterError> {
        check(stamp_s, measured)?;
        let predicted = self.predict(stamp_s, motion, ego)?;
        let covariance = &measured.covariance;
        let pose = &predicted.camera_from_markers;
        let difference = pose_difference(&measured.camera_from_markers, pose);
        // The measurement is the state's first half: H = [I 0].
        let innovation_covariance = predicted.pose_covariance() + covariance;
        let Some(factor) = innovation_covariance.cholesky() else {
            return Err(FilterError::Unusable { what: "innovation's covariance" });
        };
        let distance_squared = difference.dot(&factor.solve(&difference));
        let log_determinant = 2.0 * factor.l_dirty().diagonal().map(f64::ln).sum();
        let log_likelihood = -0.5 * (distance_squared + log_determinant);
        if distance_squared.is_nan() || distance_squared > gate {
            return Err(FilterError::Gated { distance_squared, log_likelihood, gate });
        }
        let seen = predicted.covariance.fixed_rows::<6>(0).into_owned();
        let gain: SMatrix<f64, 12, 6> = factor.solve(&seen).transpose();
        let correction: SVector<f64, 12> = gain * difference;

        // Joseph's form stays symmetric and positive in spite of rounding.
        let mut keep = StateCovariance::identity();
        let mut shrink = keep.fixed_columns_mut::<6>(0);
        shrink -= gain;
        let mut updated =
            keep * predicted.covariance * keep.transpose() + gain * covariance * gain.transpose();
        // The error is now relative to the corrected rotation (Sola, section 6.3).
        let turned = correction.fixed_rows::<3>(3).into_owned();
        let mut reset = StateCovariance::identity();
        reset.fixed_view_mut::<3, 3>(3, 3).copy_from(&left_jacobian(&turned));
        updated = reset * updated * reset.transpose();

        self.stamp_s = stamp_s;
        self.camera_from_markers = Isometry3::from_parts(
            Translation3::from(pose.translation.vector + correction.fixed_rows::<3>(0)),
            UnitQuaternion::from_scaled_axis(turned) * pose.rotation,
        );
        self.camera_from_markers.rotation.renormalize();
        self.velocity = predicted.velocity + correction.fixed_rows::<3>(6);
        self.rate = predicted.rate + correction.fixed_rows::<3>(9);
        self.covariance = (updated + updated.transpose()) / 2.0;
        Ok(log_likelihood)
    }
}

impl MotionModel {
    /// Covariance that `step` seconds of white-noise acceleration add.
    fn noise(&self, step: f64) -> StateCovariance {
        let mut noise = StateCovariance::zeros();
        for (first, density) in [(0, self.acceleration), (3, self.angular_acceleration)] {
            let power = density * density;
            for axis in first..first + 3 {
                noise[(axis, axis)] = power * step.powi(3) / 3.0;
                noise[(axis, axis + 6)] = power * step.powi(2) / 2.0;
                noise[(axis + 6, axis)] = noise[(axis, axis + 6)];
                noise[(axis + 6, axis + 6)] = power * step;
            }
        }
        noise
    }
}

/// Left Jacobian of SO(3): `exp(v + d) = exp(Jl(v) d) exp(v)` to first order in d.
fn left_jacobian(vector: &Vector3<f64>) -> Matrix3<f64> {
    let angle = vector.norm();
    let cross = vector.cross_matrix();
    // The series' next terms are below 1e-9 of these.
    let (first, second) = if angle < 1e-4 {
        (0.5, 1.0 / 6.0)
    } else {
        ((1.0 - angle.cos()) / angle.powi(2), (angle - angle.sin()) / angle.powi(3))
    };
    Matrix3::identity() + cross * first + cross * cross * second
}

fn check(stamp_s: f64, measured: &PoseEstimate) -> Result<(), FilterError> {
    let PoseEstimate { camera_from_markers: pose, covariance } = measured;
    let finite_pose = pose.translation.vector.iter().all(|x| x.is_finite())
        && (pose.rotation.quaternion().norm() - 1.0).abs() < 1e-6;
    if !stamp_s.is_finite() {
        Err(FilterError::Unusable { what: "time" })
    } else if !finite_pose {
        Err(FilterError::Unusable { what: "measured pose" })
    } else if !covariance.iter().all(|x| x.is_finite()) || covariance.cholesky().is_none() {
        Err(FilterError::Unusable { what: "measurement's covariance" })
    } else {
        Ok(())
    }
}

#[cfg(test)]
mod tests;
