//! The paper's plane: the sphere from the point opposite to its middle (section III-B).

use nalgebra::{Unit, Vector3};

use super::pixel::SpherePixel;
use crate::Ray;

/// A stereographic image about the camera's x axis: left of its middle is +y, above it +z.
///
/// A direction c radians from the axis lies rho = 2 R tan(c / 2) pixels from the middle; the
/// paper's rho = sqrt(x^2 * y^2) is a misprint for sqrt(x^2 + y^2).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stereographic {
    /// The middle's column and row, pixels.
    pub centre_px: [f64; 2],
    /// Radius of the image circle, pixels.
    pub circle_px: f64,
    /// The paper's R: pixels for each radian in the middle.
    pub radius_px: f64,
}

impl Stereographic {
    /// The plane whose circle of `field_rad` across touches the nearer borders of the image.
    pub fn new(width: u32, height: u32, field_rad: f64) -> Self {
        let circle_px = f64::from(width.min(height)) / 2.0;
        Self {
            centre_px: [width, height].map(|side| (f64::from(side) - 1.0) / 2.0),
            circle_px,
            radius_px: circle_px / (2.0 * (field_rad / 4.0).tan()),
        }
    }

    /// Ray of `pixel`, in the camera frame; `None` outside the circle.
    pub fn ray(&self, pixel: SpherePixel) -> Option<Ray> {
        let [u, v] = [pixel.0.x - self.centre_px[0], pixel.0.y - self.centre_px[1]];
        if u.hypot(v) > self.circle_px {
            return None;
        }
        // The half-angle formulas of c = 2 atan(rho / 2R) need no angle.
        let (left, up) = (-u / (2.0 * self.radius_px), -v / (2.0 * self.radius_px));
        let square = left * left + up * up;
        Some(Unit::new_normalize(Vector3::new(1.0 - square, 2.0 * left, 2.0 * up)))
    }

    /// Point that shows `ray_in_camera`; `None` outside the circle.
    pub fn project(&self, ray_in_camera: &Ray) -> Option<SpherePixel> {
        let scale = 2.0 * self.radius_px / (1.0 + ray_in_camera.x);
        let (u, v) = (-ray_in_camera.y * scale, -ray_in_camera.z * scale);
        // Straight behind, the value is infinite or NaN.
        (u.hypot(v) <= self.circle_px)
            .then(|| SpherePixel::new(u + self.centre_px[0], v + self.centre_px[1]))
    }
}
