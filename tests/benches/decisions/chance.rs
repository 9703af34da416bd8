//! Random numbers that are the same in each run.

use flockeye_geometry::ego_rotation::EgoRotation;
use flockeye_geometry::filter::{MotionEstimate, MotionModel};
use flockeye_geometry::pose::PoseEstimate;
use nalgebra::{Isometry3, Matrix6, Translation3, UnitQuaternion, Vector3, Vector6};

/// A generator of random numbers, the same in each run.
pub struct Chance(u64);

impl Chance {
    pub fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1)
    }

    /// A random number from 0 to 1.
    pub fn share(&mut self) -> f64 {
        // xorshift64
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// A random direction.
    pub fn direction(&mut self) -> Vector3<f64> {
        loop {
            let at = Vector3::from_fn(|_, _| 2.0 * self.share() - 1.0);
            if (0.1..1.0).contains(&at.norm()) {
                return at.normalize();
            }
        }
    }

    /// A random attitude.
    pub fn attitude(&mut self) -> UnitQuaternion<f64> {
        UnitQuaternion::from_scaled_axis(self.direction() * std::f64::consts::PI * self.share())
    }

    /// The prediction of a track half a second after a precise measurement of a pose, with an error
    /// that its covariance states.
    pub fn coasted(&mut self, pose: &Isometry3<f64>) -> PoseEstimate {
        let motion =
            MotionModel { initial_speed: 0.0, initial_rate: 0.0, ..MotionModel::default() };
        let measured =
            PoseEstimate { camera_from_markers: *pose, covariance: Matrix6::identity() * 1e-6 };
        let track = MotionEstimate::start(0.0, &measured, &motion).unwrap();
        let predicted = track.predict(0.5, &motion, &EgoRotation::new(1.0)).unwrap();
        let covariance = predicted.pose_covariance();
        let error = covariance.cholesky().unwrap().l() * Vector6::from_fn(|_, _| self.normal());
        let turn = UnitQuaternion::from_scaled_axis(error.fixed_rows::<3>(3).into_owned());
        let position = pose.translation.vector + error.fixed_rows::<3>(0);
        let camera_from_markers =
            Isometry3::from_parts(Translation3::from(position), turn * pose.rotation);
        PoseEstimate { camera_from_markers, covariance }
    }

    /// A normally distributed number: the sum of twelve evenly distributed ones.
    fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.share()).sum::<f64>() - 6.0
    }

    /// A start with typical errors of corner poses and predictions.
    pub fn near(&mut self, pose: &Isometry3<f64>) -> Isometry3<f64> {
        let range_m = pose.translation.vector.norm();
        let off =
            self.direction() * 0.002 + pose.translation.vector * (0.02 * (self.share() - 0.5));
        let turn = UnitQuaternion::from_scaled_axis(self.direction() * 0.03);
        let position = pose.translation.vector + off * range_m.min(1.0);
        Isometry3::from_parts(Translation3::from(position), turn * pose.rotation)
    }
}
