//! The equirectangular image that a camera has stitched.

use std::f64::consts::{PI, TAU};

use nalgebra::{Unit, Vector3};

use super::pixel::SpherePixel;
use crate::Ray;

/// Longitude along the rows, latitude along the columns.
///
/// lon = (0.5 - (u + 0.5)/W) 2 pi = atan2(y, x); lat = (0.5 - (v + 0.5)/H) pi: the image's centre
/// looks along +x, and left of it is +y.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Equirectangular {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

impl Equirectangular {
    /// Ray of the point `pixel`, in the camera frame.
    pub fn ray(&self, pixel: SpherePixel) -> Ray {
        let longitude = (0.5 - (pixel.0.x + 0.5) / f64::from(self.width)) * TAU;
        let latitude = (0.5 - (pixel.0.y + 0.5) / f64::from(self.height)) * PI;
        let (sin_lon, cos_lon) = longitude.sin_cos();
        let (sin_lat, cos_lat) = latitude.sin_cos();
        // A product of sines and cosines is a unit vector to rounding.
        Unit::new_unchecked(Vector3::new(cos_lat * cos_lon, cos_lat * sin_lon, sin_lat))
    }

    /// Point that shows `ray_in_camera`; u lies in [-0.5, W - 0.5). A pole is in every column;
    /// there the column follows from the ray's own atan2.
    pub fn project(&self, ray_in_camera: &Ray) -> SpherePixel {
        let longitude = ray_in_camera.y.atan2(ray_in_camera.x);
        let across = ray_in_camera.x.hypot(ray_in_camera.y);
        let latitude = ray_in_camera.z.atan2(across);
        let width = f64::from(self.width);
        let mut u = (0.5 - longitude / TAU) * width - 0.5;
        if u >= width - 0.5 {
            u -= width;
        }
        SpherePixel::new(u, (0.5 - latitude / PI) * f64::from(self.height) - 0.5)
    }

    /// Pixels for each radian along the equator (and along every meridian of a 2:1 image).
    pub fn pixels_per_radian(&self) -> f64 {
        f64::from(self.width) / TAU
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const CAMERA: Equirectangular = Equirectangular { width: 3840, height: 1920 };

    #[test]
    fn the_centre_looks_forward_and_left_is_left() {
        let ray = CAMERA.ray(SpherePixel::new(1919.5, 959.5));
        assert!((ray.into_inner() - Vector3::x()).norm() < 1e-12);
        let ray = CAMERA.ray(SpherePixel::new(959.5, 959.5));
        assert!((ray.into_inner() - Vector3::y()).norm() < 1e-12);
        let ray = CAMERA.ray(SpherePixel::new(1919.5, -0.5));
        assert!((ray.into_inner() - Vector3::z()).norm() < 1e-12);
    }

    proptest! {
        #[test]
        fn rays_come_back(u in -0.5..3839.49f64, v in 0.0..1919.0f64) {
            let back = CAMERA.project(&CAMERA.ray(SpherePixel::new(u, v)));
            prop_assert!((back.0.x - u).abs() < 1e-7 && (back.0.y - v).abs() < 1e-7, "{back:?}");
        }
    }
}
