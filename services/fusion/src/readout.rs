//! Rolling readout: rows exposed later show the later place of a body.
//!
//! A body covers few of the frame's rows, so it is taken as exposed at one time, that of its
//! centre's row. Tracks are predicted for that time, and measurements are converted from it to the
//! middle of the frame's exposure.

use flockeye_geometry::Ray;
use flockeye_geometry::camera::Camera;
use flockeye_geometry::pose::PoseEstimate;
use nalgebra::{Isometry3, Matrix6, UnitQuaternion, Vector3};

/// Time from the middle of the frame's exposure to that of a body's rows, seconds, negative if
/// earlier. The camera needs `readout_s` from its first to its last row.
pub(crate) fn after_s(
    camera: &Camera,
    readout_s: f64,
    camera_from_markers: &Isometry3<f64>,
) -> f64 {
    let towards = Ray::try_new(camera_from_markers.translation.vector, 1e-9);
    let row = towards.and_then(|towards| camera.project(&towards)).map(|pixel| pixel.0.y);
    row.map_or(0.0, |row| ((row + 0.5) / f64::from(camera.height()) - 0.5) * readout_s)
}

/// Extrapolates a pose in the camera frame by `by_s` seconds. The body moves at `velocity`, m/s,
/// and turns at `rate`, rad/s, relative to the camera and in its axes. The covariance of both adds
/// to that of the pose.
pub(crate) fn carried(
    pose: &PoseEstimate,
    (velocity, rate): (&Vector3<f64>, &Vector3<f64>),
    covariance: &Matrix6<f64>,
    by_s: f64,
) -> PoseEstimate {
    let Isometry3 { rotation, translation } = pose.camera_from_markers;
    let turned = UnitQuaternion::from_scaled_axis(rate * by_s);
    let position = translation.vector + velocity * by_s;
    PoseEstimate {
        camera_from_markers: Isometry3::from_parts(position.into(), turned * rotation),
        covariance: pose.covariance + covariance * (by_s * by_s),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn upper_rows_are_exposed_before_the_middle() {
        let camera = Camera::equirectangular(3840, 1920);
        let after_ms =
            |x: f64, z: f64| after_s(&camera, 0.02, &Isometry3::translation(x, 0.0, z)) * 1e3;
        assert!(after_ms(2.0, 0.0).abs() < 1e-9);
        // 45 degrees up and down: a quarter of the rows.
        assert!((after_ms(1.0, 1.0) + 5.0).abs() < 1e-9);
        assert!((after_ms(1.0, -1.0) - 5.0).abs() < 1e-9);
        assert_eq!(after_ms(0.0, 0.0), 0.0);
    }

    #[test]
    fn a_pose_is_carried_there_and_back() {
        let (velocity, rate) = (Vector3::new(1.0, -2.0, 0.5), Vector3::new(0.5, 1.0, -2.0));
        let covariance = Matrix6::from_diagonal_element(0.04);
        let carried =
            |pose: &PoseEstimate, by_s| carried(pose, (&velocity, &rate), &covariance, by_s);
        let camera_from_markers =
            Isometry3::new(Vector3::new(2.0, 0.0, 1.0), Vector3::new(0.1, 0.2, 0.3));
        let pose = PoseEstimate { camera_from_markers, covariance: Matrix6::identity() * 1e-6 };
        let later = carried(&pose, 0.01);
        let position = later.camera_from_markers.translation.vector;
        assert!((position - Vector3::new(2.01, -0.02, 1.005)).norm() < 1e-12);
        // 0.2 m/s over 10 ms are 2 mm.
        assert!((later.covariance[(0, 0)] - 5e-6).abs() < 1e-12);
        let back = carried(&later, -0.01).camera_from_markers;
        assert!((back.inverse() * camera_from_markers).rotation.angle() < 1e-12);
    }
}
