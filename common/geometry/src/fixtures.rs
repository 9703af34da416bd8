//! Random scenes for tests: the same for the same seed on every machine.
#![allow(clippy::unwrap_used, clippy::expect_used)]

pub mod flight;

use nalgebra::{Isometry3, Matrix6, Translation3, Unit, UnitQuaternion, Vector3, Vector6};

use crate::Ray;
use crate::body::{Body, Marker, squares};
use crate::pose::CornerRay;
pub use crate::random::Chance;

impl Chance {
    /// Even between `low` and `high`.
    pub fn even(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }

    /// A normal value of mean 0 and deviation 1 (Box, Muller, 1958).
    pub fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.even(0.0, 1.0)).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.even(0.0, 1.0)).cos()
    }

    /// Independent values of mean 0 and deviation 1.
    pub fn normals<const N: usize>(&mut self) -> [f64; N] {
        std::array::from_fn(|_| self.normal())
    }

    /// A direction, all alike likely.
    pub fn direction(&mut self) -> Ray {
        Unit::new_normalize(Vector3::from(self.normals()))
    }

    /// A rotation, all alike likely.
    pub fn rotation(&mut self) -> UnitQuaternion<f64> {
        let [w, x, y, z] = self.normals();
        UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(w, x, y, z))
    }

    /// In any direction, turned anyhow.
    pub fn pose(&mut self, range: f64) -> Isometry3<f64> {
        let position = self.direction().into_inner() * range;
        Isometry3::from_parts(Translation3::from(position), self.rotation())
    }
}

/// The body that the tests look at: the preset at the size of the sample data.
pub fn body() -> Body {
    squares("alpha", 0.0625, 0.05, 0)
}

/// Markers whose fronts are seen at an angle whose cosine is at least `least`.
pub fn visible<'a>(body: &'a Body, pose: &Isometry3<f64>, least: f64) -> Vec<&'a Marker> {
    body.markers
        .iter()
        .filter(|marker| {
            let towards = -(pose * marker.centre()).coords.normalize();
            (pose.rotation * marker.normal()).dot(&towards) > least
        })
        .collect()
}

/// How the corners of a marker are seen, each ray with this noise, which it states. Noise beyond
/// 3.5 deviations is cut off, so that no ray rightly looks like an outlier.
pub fn see(
    marker: &Marker,
    pose: &Isometry3<f64>,
    deviation_rad: f64,
    chance: &mut Chance,
) -> Vec<CornerRay> {
    (0..4)
        .map(|corner| {
            let seen = (pose * marker.corners[corner]).coords.normalize();
            let across =
                Vector3::from(chance.normals::<3>().map(|x| x.clamp(-3.5, 3.5))) * deviation_rad;
            CornerRay {
                marker_id: marker.id,
                corner,
                ray_in_camera: Unit::new_normalize(seen + across),
                deviation_rad,
            }
        })
        .collect()
}

/// True less found: position, then rotation vector, in the camera's axes.
pub fn error(truth: &Isometry3<f64>, found: &Isometry3<f64>) -> Vector6<f64> {
    crate::pose::pose_difference(truth, found)
}

/// Squared Mahalanobis distance.
pub fn distance_squared(error: &Vector6<f64>, covariance: &Matrix6<f64>) -> f64 {
    let factor = covariance.cholesky().expect("a covariance");
    error.dot(&factor.solve(error))
}

/// Best known covering diameters, degrees: proved for 4 to 7, 10, 12 and 14 (L. Fejes Toth,
/// Schuette, G. Fejes Toth), else from the tables of Tarnai and Gaspar and of Sloane.
pub const BEST_KNOWN_DEG: [(usize, f64); 16] = [
    (4, 141.0576),
    (5, 126.8699),
    (6, 109.4712),
    (7, 102.0531),
    (8, 96.2791),
    (9, 91.7578),
    (10, 84.6157),
    (11, 82.8544),
    (12, 74.7547),
    (13, 74.1371),
    (14, 69.8759),
    (15, 68.0798),
    (16, 65.7976),
    (20, 59.2462),
    (24, 53.71),
    (32, 45.3810),
];
