//! Lenses beside the camera's middle: rays corrected to the distance of the target.
//!
//! A view's rays are exact for one distance: that of its neighbour, or the assumed one. After a
//! pose gives the neighbour's actual distance, the correction is known. It is the same for all rays
//! of a body from one lens.

use flockeye_contract::ViewHeader;
use flockeye_geometry::Ray;
use flockeye_geometry::camera::{Camera, CameraModel};
use flockeye_geometry::pose::PoseEstimate;
use nalgebra::{Isometry3, UnitQuaternion, Vector3};

/// The camera's lenses, if they sit beside its middle.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Parallax {
    camera: Camera,
    /// Assumed distance without a prediction, metres.
    pub(crate) assumed_m: f64,
}

impl Parallax {
    /// Creates the correction of a camera that is exact for `assumed_m` without a prediction;
    /// `None` if all of its rays meet in its middle, and for a stitched camera, of which
    /// [`StitchEstimate`](crate::stitching::StitchEstimate) knows more.
    pub(crate) fn of(camera: &Camera, assumed_m: f64) -> Option<Self> {
        let camera = camera.at_distance(assumed_m);
        let is_stitched = matches!(camera.model(), CameraModel::Equirectangular { .. });
        // The distance matters only for lenses beside the middle.
        (camera.nearness() > 0.0 && !is_stitched).then_some(Self { camera, assumed_m })
    }

    /// Distance for which a view's rays are exact, metres.
    pub(crate) fn distance_m(&self, view: Option<&ViewHeader>) -> f64 {
        view.and_then(predicted_distance_m).unwrap_or(self.assumed_m)
    }

    /// Converts a ray that is exact for `from_m` to `to_m`.
    pub(crate) fn brought(&self, ray_in_camera: &Ray, from_m: f64, to_m: f64) -> Ray {
        let seen = self.camera.at_distance(from_m).project(ray_in_camera);
        seen.and_then(|pixel| self.camera.at_distance(to_m).ray(pixel)).unwrap_or(*ray_in_camera)
    }

    /// Corrects a pose from rays that were exact for `rays_m` to its own distance, by a rotation
    /// about the camera's middle.
    pub(crate) fn corrected(&self, estimate: &PoseEstimate, rays_m: f64) -> PoseEstimate {
        let position = estimate.camera_from_markers.translation.vector;
        let Some(towards) = Ray::try_new(position, 1e-9) else { return *estimate };
        let brought = self.brought(&towards, rays_m, position.norm());
        let turn = UnitQuaternion::rotation_between_axis(&towards, &brought).unwrap_or_default();
        let camera_from_markers =
            Isometry3::from_parts(Default::default(), turn) * estimate.camera_from_markers;
        PoseEstimate { camera_from_markers, ..*estimate }
    }
}

/// The distance for which a view's rays are exact, metres; `None` for one without a prediction.
pub(crate) fn predicted_distance_m(view: &ViewHeader) -> Option<f64> {
    let [x, y, z] = view.predicted_camera_from_markers.position;
    (view.has_prediction != 0).then(|| Vector3::new(x, y, z).norm())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;
    use std::f64::consts::PI;

    use flockeye_geometry::camera::{Lens, LensCurve};
    use nalgebra::{Matrix6, Translation3, Unit, Vector2};

    /// Two lenses back to back, each 8 mm from the middle.
    fn camera() -> Camera {
        let lens = |forward: Vector3<f64>, column: f64| Lens {
            camera_from_lens: Isometry3::from_parts(
                Translation3::from(forward * 0.008),
                UnitQuaternion::rotation_between(&Vector3::z(), &forward)
                    .unwrap_or(UnitQuaternion::from_axis_angle(&Vector3::y_axis(), PI)),
            ),
            centre_px: Vector2::new(column, 959.5),
            circle_px: 959.0,
            field_rad: 3.3,
            focal_px: Vector2::repeat(580.0),
            curve: LensCurve::Equidistant([0.0; 4]),
        };
        let lenses = [lens(Vector3::x(), 959.5), lens(-Vector3::x(), 2879.5)];
        Camera::new(3840, 1920, CameraModel::DualFisheye(lenses)).unwrap()
    }

    #[test]
    fn a_camera_with_one_centre_has_none() {
        assert_eq!(Parallax::of(&Camera::equirectangular(3840, 1920), 1.5), None);
    }

    #[test]
    fn a_pose_comes_to_where_its_distance_wants_it() {
        let parallax = Parallax::of(&camera(), 1.5).unwrap();
        let truth = Vector3::new(0.3, 0.5, -0.1);
        // What the lens sees of the truth, read as if it were 1.5 m away.
        let pixel =
            camera().at_distance(truth.norm()).project(&Unit::new_normalize(truth)).unwrap();
        let read = camera().at_distance(1.5).ray(pixel).unwrap();
        let wrong = PoseEstimate {
            camera_from_markers: Translation3::from(read.into_inner() * truth.norm()).into(),
            covariance: Matrix6::identity() * 1e-8,
        };
        let error = (wrong.camera_from_markers.translation.vector - truth).norm();
        assert!((0.003..0.008).contains(&error), "{error}");
        let right = parallax.corrected(&wrong, 1.5);
        assert!((right.camera_from_markers.translation.vector - truth).norm() < 1e-6);
    }

    #[test]
    fn rays_are_right_for_the_predicted_distance() {
        let parallax = Parallax::of(&camera(), 1.5).unwrap();
        assert_eq!(parallax.distance_m(None), 1.5);
        let mut view = ViewHeader { has_prediction: 1, ..ViewHeader::default() };
        view.predicted_camera_from_markers.position = [0.0, 3.0, 4.0];
        assert_eq!(parallax.distance_m(Some(&view)), 5.0);
        let ray = Unit::new_normalize(Vector3::new(0.2, 1.0, 0.4));
        let there = parallax.brought(&ray, 1.5, 0.5);
        let back = parallax.brought(&there, 0.5, 1.5);
        assert!((back.into_inner() - ray.into_inner()).norm() < 1e-9);
        assert!(there.angle(&ray) > 0.005);
    }
}
