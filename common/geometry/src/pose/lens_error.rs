//! The error of a lens model: how far rays may be off, and what that does to a pose.
//!
//! The model's parameters are fitted, so its error changes slowly over the picture. Neighbouring
//! corners have nearly the same error, however many there are. It is a random field over the
//! sphere: equal variance everywhere, and a correlation that falls with the angle between two rays.

use nalgebra::{Matrix6, Matrix6x3};

use super::PoseEstimate;
use super::rays::tangent;
use super::residual::by_pose;
use crate::Ray;
use crate::body::Body;

/// Distance of two unit rays at which the correlation of their errors is exp(-1/2): an angle in
/// radians, nearly.
///
/// An assumption: polynomials of fisheye lenses have four or five terms over 90 degrees.
const CORRELATION_RAD: f64 = 0.35;

/// The error of a lens model.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct LensError {
    /// Standard deviation of a ray, in each direction, radians.
    pub deviation_rad: f64,
}

impl LensError {
    /// The deviation of a corner with this deviation of its own, radians.
    pub fn with(&self, deviation_rad: f64) -> f64 {
        deviation_rad.hypot(self.deviation_rad)
    }

    /// The estimate of a pose of `body`, with the lens's error in its covariance.
    ///
    /// The pose is taken to follow the rays of all corners that face the camera, each with the same
    /// weight: x = (JᵀJ + s² D)⁻¹ Jᵀ e, with e their errors, s the deviation and J their derivative by
    /// the pose. Some directions may have no information. D is a weak prior, so that the matrix has an
    /// inverse. Its deviations are the range for the position and one radian for the rotation.
    /// Where no marker faces the camera, all corners count.
    pub fn added(&self, estimate: &PoseEstimate, body: &Body) -> PoseEstimate {
        if self.deviation_rad <= 0.0 {
            return *estimate;
        }
        let covariance = estimate.covariance + self.covariance(estimate, body);
        PoseEstimate { covariance, ..*estimate }
    }

    /// Covariance of the pose from the lens's error alone.
    fn covariance(&self, estimate: &PoseEstimate, body: &Body) -> Matrix6<f64> {
        let pose = &estimate.camera_from_markers;
        let facing = body.markers.iter().filter(|marker| {
            let centre = (pose * marker.centre()).coords;
            (pose.rotation * marker.normal()).dot(&centre) < 0.0
        });
        let mut corners: Vec<_> = facing.flat_map(|marker| marker.corners).collect();
        if corners.is_empty() {
            corners = body.markers.iter().flat_map(|marker| marker.corners).collect();
        }
        let range_m = pose.translation.vector.norm();
        let mut prior = Matrix6::identity();
        prior.fixed_view_mut::<3, 3>(0, 0).fill_diagonal(1.0 / range_m.powi(2));
        let mut information = prior * self.deviation_rad.powi(2);
        // The direction of each corner, and Jᵀ by an error of its ray in the camera's axes.
        let mut sights = Vec::new();
        for corner in corners {
            let arm = pose.rotation * corner.coords;
            let seen = arm + pose.translation.vector;
            let Some(direction) = Ray::try_new(seen, 1e-9) else { continue };
            let across = tangent(&direction);
            let jacobian = by_pose(&(across.transpose() / seen.norm()), &arm);
            information += jacobian.transpose() * jacobian;
            sights.push((direction, jacobian.transpose() * across.transpose()));
        }
        let Some(factor) = information.cholesky() else { return Matrix6::zeros() };
        let mut squared = Matrix6::zeros();
        for (number, (direction, pulled)) in sights.iter().enumerate() {
            let mut before = Matrix6x3::zeros();
            for (other, pulled) in &sights[..number] {
                let apart = (direction.as_ref() - other.as_ref()) / CORRELATION_RAD;
                before += pulled * (-0.5 * apart.norm_squared()).exp();
            }
            let of_pairs = before * pulled.transpose();
            squared += of_pairs + of_pairs.transpose() + pulled * pulled.transpose();
        }
        let inverse = factor.inverse();
        inverse * squared * inverse * self.deviation_rad.powi(2)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::expect_used)]
    use nalgebra::{Isometry3, Translation3, Unit, Vector3};

    use super::*;
    use crate::fixtures::{Chance, body, distance_squared, error, see, visible};
    use crate::pose::{CornerRay, solve};

    const ERROR: LensError = LensError { deviation_rad: 1e-3 };

    fn exact(camera_from_markers: Isometry3<f64>) -> PoseEstimate {
        PoseEstimate { camera_from_markers, covariance: Matrix6::zeros() }
    }

    /// One draw of the field: waves whose wave numbers are normal have a Gaussian correlation.
    fn field(chance: &mut Chance) -> impl Fn(&Ray) -> Vector3<f64> + use<> {
        const WAVES: usize = 60;
        let waves: Vec<[Vector3<f64>; 3]> =
            (0..WAVES).map(|_| std::array::from_fn(|_| chance.normals().into())).collect();
        move |ray| {
            let wave = |[number, cosine, sine]: &[Vector3<f64>; 3]| {
                let phase = number.dot(ray) / CORRELATION_RAD;
                cosine * phase.cos() + sine * phase.sin()
            };
            let sum: Vector3<f64> = waves.iter().map(wave).sum();
            sum * (ERROR.deviation_rad / (WAVES as f64).sqrt())
        }
    }

    /// Poses of several markers and of a single one, solved from rays with one draw of the field.
    #[test]
    fn poses_behind_a_wrong_lens_are_off_by_the_covariance() {
        let mut chance = Chance::new(31);
        for (range_m, most) in [(0.5, 9), (0.8, 9), (0.3, 1)] {
            let (mut nees, mut count) = (0.0, 0.0);
            for _ in 0..300 {
                let truth = chance.pose(range_m);
                let mut body = body();
                let mut seen: Vec<u32> =
                    visible(&body, &truth, 0.3).iter().map(|marker| marker.id).collect();
                seen.truncate(most);
                body.markers.retain(|marker| seen.contains(&marker.id));
                let off = field(&mut chance);
                let rays: Vec<CornerRay> = body
                    .markers
                    .iter()
                    .flat_map(|marker| see(marker, &truth, 1e-9, &mut chance))
                    .map(|ray| CornerRay {
                        ray_in_camera: Unit::new_normalize(
                            ray.ray_in_camera.as_ref() + off(&ray.ray_in_camera),
                        ),
                        deviation_rad: ERROR.with(1e-9),
                        ..ray
                    })
                    .collect();
                let Ok(found) = solve(&body, &rays) else { continue };
                // A single marker has a mirror pose; the nearer one is meant.
                let errors = found.iter().map(|found| error(&truth, &found.camera_from_markers));
                let error = errors.min_by(|a, b| a.norm().total_cmp(&b.norm())).expect("some");
                let stated = ERROR.added(&exact(truth), &body).covariance;
                nees += distance_squared(&error, &stated);
                count += 1.0;
            }
            println!("{most} markers at {range_m} m: NEES {} of {count} poses", nees / count);
            // 6 is right.
            assert!(count > 250.0 && (5.0..7.0).contains(&(nees / count)), "{}", nees / count);
        }
    }

    /// Far away all corners have one error: the body is aside by it.
    #[test]
    fn a_distant_body_is_aside_by_the_error_of_the_lens() {
        let there = Isometry3::from_parts(Translation3::new(20.0, 0.0, 0.0), Default::default());
        let found = ERROR.added(&exact(there), &body()).covariance;
        let aside_m = found[(1, 1)].sqrt();
        assert!((aside_m / 20e-3 - 1.0).abs() < 0.02, "{aside_m}");
        assert_eq!(LensError::default().added(&exact(there), &body()), exact(there));
    }
}
