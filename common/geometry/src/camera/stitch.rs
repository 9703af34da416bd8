//! How the two lenses of a stitched picture differ from one lens in the camera's middle.
//!
//! A stitched picture has two halves, each from a lens of its own. A thing is shown by the half
//! ahead (s = 1) or behind (s = -1) as if the camera were turned by s d about its middle, with
//!
//! ```text
//! d = (a - c / r) (p x e) + t
//! ```
//!
//! | symbol | meaning |
//! | --- | --- |
//! | e, p, r | the lenses' axis; direction and distance of the thing from the middle |
//! | c | half the distance between the lenses |
//! | a | angle at the border by which the stitcher has moved the halves together: c over the distance for which it has stitched, and the error of the lenses' own curves at their rims |
//! | t | half the turn of one lens against the other |
//!
//! d is the *disparity* of the halves there. c, a and t are constants of the camera that its
//! pictures show where a body lies across the border between the halves.

use nalgebra::{
    Isometry3, Matrix5, Matrix6, SMatrix, Translation3, UnitQuaternion, Vector3, Vector5,
};

use crate::Ray;
use crate::pose::PoseEstimate;

/// Distance from the border up to which both lenses may show in a pixel, radians: half of the strip
/// over which stitchers blend, which is a few degrees wide.
const BLENDED_RAD: f64 = 0.03;

/// A half of a stitched picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Half {
    /// The half of the lens that looks along +x.
    Ahead,
    /// The half of the lens that looks along -x.
    Behind,
}

impl Half {
    /// Both halves.
    pub const ALL: [Self; 2] = [Self::Ahead, Self::Behind];

    /// The half that shows a direction in the camera frame.
    pub fn of(direction: &Vector3<f64>) -> Self {
        if direction.x >= 0.0 { Self::Ahead } else { Self::Behind }
    }

    /// 1 ahead, -1 behind.
    pub fn sign(self) -> f64 {
        match self {
            Self::Ahead => 1.0,
            Self::Behind => -1.0,
        }
    }

    /// The half whose picture a pixel in this direction shows unmixed; `None` where both may show.
    pub fn unmixed(direction: &Vector3<f64>) -> Option<Self> {
        let is_mixed = direction.x.abs() < BLENDED_RAD * direction.norm();
        (!is_mixed).then_some(Self::of(direction))
    }
}

/// What shows a body in a stitched picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ShownBy {
    /// One half shows all of it.
    One(Half),
    /// Each half shows a part.
    Both,
    /// It lies in the strip where both lenses may show, on top of each other.
    Mixed,
}

impl ShownBy {
    /// What shows a body of `radius_m` with its middle at this place in the camera frame. A half counts
    /// if it shows a part of the body unmixed.
    pub fn of(place_in_camera: &Vector3<f64>, radius_m: f64) -> Self {
        match Half::ALL
            .map(|half| Half::unmixed(&rim(place_in_camera, radius_m, half)) == Some(half))
        {
            [true, false] => Self::One(Half::Ahead),
            [false, true] => Self::One(Half::Behind),
            [true, true] => Self::Both,
            [false, false] => Self::Mixed,
        }
    }
}

/// The point of a body's outline that lies farthest into a half.
fn rim(place_in_camera: &Vector3<f64>, radius_m: f64, half: Half) -> Vector3<f64> {
    let middle = place_in_camera.normalize();
    let radius_rad = (radius_m / place_in_camera.norm()).min(1.0).asin();
    let inwards = Vector3::x() * half.sign() - middle * (middle.x * half.sign());
    match inwards.try_normalize(1e-9) {
        Some(inwards) => middle * radius_rad.cos() + inwards * radius_rad.sin(),
        None => middle,
    }
}

/// The constants of a stitched camera, and how well they are known.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stitch {
    /// Half the distance between the lenses (m), the halves' shift at the border (rad), half the turn
    /// between the lenses (rotation vector in the camera frame, rad).
    constants: Vector5<f64>,
    /// Their covariance.
    covariance: Matrix5<f64>,
    /// Shift at the border by which a view's rays have been made exact for a distance, radians.
    shift_of_view: f64,
}

impl Stitch {
    /// Creates a camera with this half distance between its lenses, stitched for infinity.
    /// `deviations`: of that distance (m), of the shift at the border (rad), and of each component of
    /// half the turn (rad).
    pub fn new(half_distance_m: f64, deviations: [f64; 3]) -> Self {
        let [distance, shift, turn] = deviations.map(|deviation| deviation.powi(2));
        let variances = Vector5::new(distance, shift, turn, turn, turn);
        let constants = Vector5::x() * half_distance_m;
        let covariance = Matrix5::from_diagonal(&variances);
        Self { constants, covariance, shift_of_view: 0.0 }
    }

    /// Creates a camera from its constants (see the module) and their covariance. `None` unless they
    /// are finite.
    pub fn of(constants: Vector5<f64>, covariance: Matrix5<f64>) -> Option<Self> {
        let is_finite = constants.iter().chain(covariance.iter()).all(|x| x.is_finite());
        is_finite.then_some(Self { constants, covariance, shift_of_view: 0.0 })
    }

    /// The constants: see [`Stitch::of`].
    pub fn constants(&self) -> &Vector5<f64> {
        &self.constants
    }

    /// Their covariance.
    pub fn covariance(&self) -> &Matrix5<f64> {
        &self.covariance
    }

    /// Distance between the lenses, metres.
    pub fn lens_distance_m(&self) -> f64 {
        2.0 * self.constants[0]
    }

    /// This camera in a view whose rays have been made exact for things at `metres` with the lens
    /// distance `lens_distance_m`. Its constants stay those of the camera.
    pub fn seen_at(&self, lens_distance_m: f64, metres: f64) -> Self {
        Self { shift_of_view: lens_distance_m / 2.0 / metres, ..*self }
    }

    /// The constants with the view's shift.
    fn in_view(&self) -> Vector5<f64> {
        self.constants + Vector5::y() * self.shift_of_view
    }

    /// The camera with constants that differ by this much.
    pub fn changed(&self, by: &Vector5<f64>) -> Self {
        Self { constants: self.constants + by, ..*self }
    }

    /// Derivative of the disparity at a place by the constants.
    pub fn by_constants(place_in_camera: &Vector3<f64>) -> SMatrix<f64, 3, 5> {
        let range_m = place_in_camera.norm();
        let axis = place_in_camera.cross(&Vector3::x()) / range_m;
        let mut by = SMatrix::<f64, 3, 5>::zeros();
        by.set_column(0, &(-axis / range_m));
        by.set_column(1, &axis);
        by.fixed_view_mut::<3, 3>(0, 2).fill_with_identity();
        by
    }

    /// The disparity at a place, a rotation vector in the camera frame, radians.
    pub fn disparity(&self, place_in_camera: &Vector3<f64>) -> Vector3<f64> {
        Self::by_constants(place_in_camera) * self.in_view()
    }

    /// Size of the disparity at a place, as far as it is known, and its deviation; radians.
    pub fn extent_rad(&self, place_in_camera: &Vector3<f64>) -> (f64, f64) {
        let by = Self::by_constants(place_in_camera);
        let variance = (by * self.covariance * by.transpose()).trace();
        (self.disparity(place_in_camera).norm(), variance.max(0.0).sqrt())
    }

    /// `shown_from_camera`: moves a body to where a half of the picture seems to show it. `place` is
    /// the body's middle. The lens's parallax is exact for the body's depth. A shift at the border
    /// also magnifies what lies ahead and behind, as if it were nearer or farther.
    pub fn shown_from_camera(&self, half: Half, place_in_camera: &Vector3<f64>) -> Isometry3<f64> {
        let [distance, shift, x, y, z] = self.in_view().into();
        let (sign, sight) = (half.sign(), place_in_camera.normalize());
        let turn = (sight.cross(&Vector3::x()) * shift + Vector3::new(x, y, z)) * sign;
        let lens = Vector3::x() * (sign * distance);
        let away = sight * (sign * shift * place_in_camera.x);
        let turned = UnitQuaternion::from_scaled_axis(turn) * Translation3::from(-lens);
        Translation3::from(away) * turned
    }

    /// Derivative of the pose at which a half shows a body by the constants: of its position (m) and
    /// of its rotation vector (rad), in the camera frame. `place` is the body's middle.
    pub fn pose_by_constants(half: Half, place_in_camera: &Vector3<f64>) -> SMatrix<f64, 6, 5> {
        let mut by = SMatrix::<f64, 6, 5>::zeros();
        by[(0, 0)] = -1.0;
        by[(0, 1)] = place_in_camera.norm();
        let axis = place_in_camera.normalize().cross(&Vector3::x());
        by.fixed_view_mut::<3, 1>(3, 1).copy_from(&axis);
        by.fixed_view_mut::<3, 3>(0, 2).copy_from(&-place_in_camera.cross_matrix());
        by.fixed_view_mut::<3, 3>(3, 2).fill_with_identity();
        by * half.sign()
    }

    /// The ray from the camera's middle to what a half shows along `seen` at `metres` from the middle,
    /// and its deviation in each direction, radians. Where both halves may show, it is between what
    /// they show, and their disparity is part of the deviation.
    pub fn ray(&self, seen: &Ray, metres: f64) -> (Ray, f64) {
        let place = seen.into_inner() * metres;
        let (size, deviation) = self.extent_rad(&place);
        match Half::unmixed(seen) {
            Some(half) => {
                let turn = self.disparity(&place) * -half.sign();
                (UnitQuaternion::from_scaled_axis(turn) * seen, deviation)
            }
            None => (*seen, deviation.hypot(size)),
        }
    }

    /// Corrects a pose that comes from the rays of one half, made exact for things at `rays_m` from
    /// the middle ([`Stitch::ray`]), to its own distance.
    pub fn corrected(&self, estimate: &PoseEstimate, rays_m: f64) -> PoseEstimate {
        let place = estimate.camera_from_markers.translation.vector;
        let Some(half) = Half::unmixed(&place) else {
            let covariance = estimate.covariance + self.mixed_covariance(&place);
            return PoseEstimate { covariance, ..*estimate };
        };
        // A shift at the border that stays, because the rays were exact for another distance.
        let left = Vector5::y() * self.constants[0] * (1.0 / rays_m - 1.0 / place.norm());
        let left = Self { constants: left, ..*self };
        let camera_from_markers =
            left.shown_from_camera(half, &place).inverse() * estimate.camera_from_markers;
        PoseEstimate { camera_from_markers, ..*estimate }
    }

    /// Covariance of a body's pose from what is not known of the half that shows it: position (m),
    /// then rotation vector (rad), in the camera frame. All poses from one half have this error in
    /// common.
    pub fn pose_covariance(&self, place_in_camera: &Vector3<f64>) -> Matrix6<f64> {
        let by = Self::pose_by_constants(Half::Ahead, place_in_camera);
        by * self.covariance * by.transpose()
    }

    /// Covariance of the pose of a body where both halves may show it, if it is taken to be between
    /// where they show it.
    pub fn mixed_covariance(&self, place_in_camera: &Vector3<f64>) -> Matrix6<f64> {
        let moved = Self::pose_by_constants(Half::Ahead, place_in_camera) * self.in_view();
        moved * moved.transpose()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use nalgebra::Point3;
    use proptest::prelude::*;

    use super::*;
    use crate::camera::{Camera, CameraModel};
    use crate::fixtures::{Chance, body, see, visible};
    use crate::pose::{CornerRay, solve};

    fn place() -> impl Strategy<Value = Vector3<f64>> {
        let direction = prop::array::uniform3(-1.0..1.0f64).prop_map(Vector3::from);
        let unit = direction.prop_filter_map("a direction", |it| it.try_normalize(0.1));
        (unit, 0.3..4.0f64).prop_map(|(unit, range_m)| unit * range_m)
    }

    /// Where a half shows a place.
    fn shown(stitch: &Stitch, half: Half, place: &Vector3<f64>) -> Vector3<f64> {
        (stitch.shown_from_camera(half, place) * Point3::from(*place)).coords.normalize()
    }

    proptest! {
        /// The stitched camera model has its lenses beside the middle, and the picture of infinity.
        #[test]
        fn halves_show_what_their_lenses_see(place in place()) {
            let model = CameraModel::Equirectangular { lens_distance_m: 0.016 };
            let camera = Camera::new(3840, 1920, model).unwrap();
            let direction = Ray::new_normalize(place);
            prop_assume!(place.x.abs() > 0.05 * place.norm());
            let pixel = camera.at_distance(place.norm()).project(&direction).unwrap();
            let seen = camera.at_distance(f64::INFINITY).ray(pixel).unwrap();
            let stitch = Stitch::new(0.008, [0.0; 3]);
            prop_assert!((shown(&stitch, Half::of(&place), &place) - *seen).norm() < 1e-9);
            let (ray, _) = stitch.ray(&seen, place.norm());
            // To first order in the lenses' distance: by less than a fifth of a pixel at 0.5 m.
            let off = ray.angle(&direction) * place.norm_squared();
            prop_assert!(off < 0.0002, "{off}");
        }

        #[test]
        fn derivatives_are_those_of_what_is_shown(place in place(), which in 0usize..5) {
            let step = 1e-4;
            let mut constants = Vector5::zeros();
            constants[which] = step;
            let stitch = Stitch::new(0.0, [0.0; 3]).changed(&constants);
            let moved = stitch.shown_from_camera(Half::Behind, &place) * Translation3::from(place);
            let by = Stitch::pose_by_constants(Half::Behind, &place) * constants;
            let shift = moved.translation.vector - place;
            prop_assert!((shift - by.fixed_rows::<3>(0)).norm() < 1e-6, "{shift}");
            prop_assert!((moved.rotation.scaled_axis() - by.fixed_rows::<3>(3)).norm() < 1e-9);
            let turn = stitch.disparity(&place) * -1.0;
            let expected = place.normalize() + turn.cross(&place.normalize());
            prop_assert!((moved.translation.vector.normalize() - expected).norm() < 1e-6);
        }

        /// A shift at the border magnifies: neighbouring directions move as one body does.
        #[test]
        fn a_body_is_shown_as_its_points_are(place in place(), arm in prop::array::uniform3(-0.05..0.05f64)) {
            let stitch = Stitch::new(0.0, [0.0; 3]).changed(&(Vector5::y() * 1e-3));
            let shown = stitch.shown_from_camera(Half::Ahead, &place);
            let point = place + Vector3::from(arm);
            let own = Stitch::by_constants(&point) * stitch.constants;
            let expected = UnitQuaternion::from_scaled_axis(own) * point.normalize();
            let found = (shown * Point3::from(point)).coords.normalize();
            // The body is turned by its middle's angle: second order in its size.
            let limit = 1e-3 * (2.5 * Vector3::from(arm).norm() / place.norm()).powi(2) + 1e-6;
            prop_assert!((found - expected).norm() < limit, "{}", (found - expected).norm());
        }
    }

    /// Corner rays of one half, made exact for a wrong distance: the distance of the pose puts it right.
    #[test]
    fn a_pose_comes_to_where_its_distance_wants_it() {
        let mut chance = Chance::new(5);
        let stitch = Stitch::new(0.008, [0.0; 3]).changed(&(Vector5::y() * 0.003));
        let mut count = 0;
        for _ in 0..100 {
            let truth = chance.pose(0.5);
            let place = truth.translation.vector;
            if Half::unmixed(&(place * (1.0 - 0.3 / place.norm()))).is_none() {
                continue;
            }
            let shown_from_markers = stitch.shown_from_camera(Half::of(&place), &place) * truth;
            let body = body();
            let rays: Vec<CornerRay> = visible(&body, &truth, 0.3)
                .into_iter()
                .flat_map(|marker| see(marker, &shown_from_markers, 1e-9, &mut chance))
                .map(|ray| CornerRay {
                    ray_in_camera: stitch.ray(&ray.ray_in_camera, 1.5).0,
                    deviation_rad: 1e-4,
                    ..ray
                })
                .collect();
            let is_whole =
                |ray: &CornerRay| Half::unmixed(&ray.ray_in_camera) == Some(Half::of(&place));
            // Few markers have mirror poses.
            if rays.len() < 12 || !rays.iter().all(is_whole) {
                continue;
            }
            let Ok(found) = solve(&body, &rays) else { continue };
            let found = &found[0];
            count += 1;
            let estimate = PoseEstimate {
                camera_from_markers: found.camera_from_markers,
                covariance: Matrix6::zeros(),
            };
            let right = stitch.corrected(&estimate, 1.5).camera_from_markers;
            let off = (right.translation.vector - place).norm();
            let before = (found.camera_from_markers.translation.vector - place).norm();
            assert!(off < 0.6e-3 && off < 0.3 * before, "{off} of {before}");
        }
        assert!(count > 20, "{count}");
    }

    #[test]
    fn poses_are_as_uncertain_as_the_lenses() {
        let stitch = Stitch::new(0.0, [0.006, 0.0, 0.0]);
        for place in [Vector3::new(0.0, 1.2, 0.0), Vector3::new(1.2, 0.0, 0.0)] {
            let aside = stitch.pose_covariance(&place);
            // A lens that is 6 mm ahead shows things 6 mm farther back.
            assert!((aside[(0, 0)].sqrt() - 0.006).abs() < 1e-9, "{aside}");
            assert!((aside.norm() - aside[(0, 0)]).abs() < 1e-12, "{aside}");
        }
        let seen = Ray::new_normalize(Vector3::new(0.01, 1.0, 0.0));
        let known = Stitch::new(0.008, [0.0; 3]);
        assert!((known.ray(&seen, 0.8).1 - 0.01).abs() < 1e-4, "both halves show there");
        let seen = Ray::new_normalize(Vector3::new(0.1, 1.0, 0.0));
        assert_eq!(known.ray(&seen, 0.8).1, 0.0);
    }

    #[test]
    fn a_view_made_exact_for_its_distance_shows_no_disparity_there() {
        let place = Vector3::new(0.1, 1.0, 0.3);
        let stitch = Stitch::new(0.008, [0.0; 3]).seen_at(0.016, place.norm());
        assert!(stitch.disparity(&place).norm() < 1e-12);
        assert!(stitch.disparity(&(place * 2.0)).norm() > 0.003);
        assert_eq!(Stitch::of(Vector5::repeat(f64::NAN), Matrix5::zeros()), None);
    }
}
