//! Rolling readout: rows that are exposed later show a body where it is later.
//!
//! A body covers few of the frame's rows, so it is taken as exposed at one time, that of its
//! centre's row. What a track says is asked for at that time, and what a picture says is brought
//! from there to the middle of the frame's exposure.

use flockeye_geometry::Ray;
use flockeye_geometry::camera::Camera;
use nalgebra::{Isometry3, Matrix6, UnitQuaternion, Vector3};

use crate::measurement::PoseEstimate;

/// A camera whose rows are exposed one after the other.
#[derive(Debug, Clone, PartialEq)]
pub struct Readout {
    camera: Camera,
    readout_s: f64,
}

/// How a body moves as the camera sees it, in the camera's axes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ApparentMotion {
    /// m/s.
    pub velocity: Vector3<f64>,
    /// rad/s.
    pub rate: Vector3<f64>,
    /// Covariance of both.
    pub covariance: Matrix6<f64>,
}

impl Readout {
    /// For a camera that needs `readout_s` from its first to its last row; `None` if all are
    /// exposed at once.
    pub fn of(camera: &Camera, readout_s: f64) -> Option<Self> {
        (readout_s > 0.0).then_some(Self { camera: *camera, readout_s })
    }

    /// How long after the middle of the frame's exposure (negative: before it) a body's rows are
    /// exposed, seconds. Its pose is `camera_from_markers`.
    pub fn after_s(&self, camera_from_markers: &Isometry3<f64>) -> f64 {
        let towards = Ray::try_new(camera_from_markers.translation.vector, 1e-9);
        let row = towards.and_then(|towards| self.camera.project(&towards)).map(|pixel| pixel.0.y);
        let height = f64::from(self.camera.height());
        row.map_or(0.0, |row| ((row + 0.5) / height - 0.5) * self.readout_s)
    }
}

impl ApparentMotion {
    /// A pose in the camera frame as it is `by_s` seconds later, as certain as the motion lets it
    /// be.
    pub fn carried(&self, pose: &PoseEstimate, by_s: f64) -> PoseEstimate {
        let Isometry3 { rotation, translation } = pose.camera_from_markers;
        let turned = UnitQuaternion::from_scaled_axis(self.rate * by_s);
        let position = translation.vector + self.velocity * by_s;
        PoseEstimate {
            camera_from_markers: Isometry3::from_parts(position.into(), turned * rotation),
            covariance: pose.covariance + self.covariance * (by_s * by_s),
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn upper_rows_are_exposed_before_the_middle() {
        let camera = Camera::equirectangular(3840, 1920);
        assert_eq!(Readout::of(&camera, 0.0), None);
        let readout = Readout::of(&camera, 0.02).unwrap();
        let after_ms = |x: f64, z: f64| readout.after_s(&Isometry3::translation(x, 0.0, z)) * 1e3;
        assert!(after_ms(2.0, 0.0).abs() < 1e-9);
        // 45 degrees up and down: a quarter of the rows.
        assert!((after_ms(1.0, 1.0) + 5.0).abs() < 1e-9);
        assert!((after_ms(1.0, -1.0) - 5.0).abs() < 1e-9);
        assert_eq!(after_ms(0.0, 0.0), 0.0);
    }

    #[test]
    fn a_pose_is_carried_there_and_back() {
        let motion = ApparentMotion {
            velocity: Vector3::new(1.0, -2.0, 0.5),
            rate: Vector3::new(0.5, 1.0, -2.0),
            covariance: Matrix6::from_diagonal_element(0.04),
        };
        let camera_from_markers =
            Isometry3::new(Vector3::new(2.0, 0.0, 1.0), Vector3::new(0.1, 0.2, 0.3));
        let pose = PoseEstimate { camera_from_markers, covariance: Matrix6::identity() * 1e-6 };
        let later = motion.carried(&pose, 0.01);
        let position = later.camera_from_markers.translation.vector;
        assert!((position - Vector3::new(2.01, -0.02, 1.005)).norm() < 1e-12);
        // 0.2 m/s over 10 ms are 2 mm.
        assert!((later.covariance[(0, 0)] - 5e-6).abs() < 1e-12);
        let back = motion.carried(&later, -0.01).camera_from_markers;
        assert!((back.inverse() * camera_from_markers).rotation.angle() < 1e-12);
    }
}
