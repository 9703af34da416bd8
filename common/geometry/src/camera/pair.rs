//! The two lenses of a camera, one by one.

use nalgebra::Vector3;

use super::{Camera, CameraModel};
use crate::Ray;

/// Ray of one of two lenses.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LensRay {
    /// Index of the lens: 0 looks ahead.
    pub lens: usize,
    /// The direction in the camera's axes, from that lens.
    pub ray: Ray,
    /// Angle from the seam, where the picture of the other lens begins, radians.
    pub from_seam_rad: f64,
}

impl Camera {
    /// Positions of the two lenses in the camera, metres; `None` for a camera model with one
    /// centre.
    pub fn lens_positions(&self) -> Option<[Vector3<f64>; 2]> {
        match &self.model {
            CameraModel::Equirectangular { lens_distance_m } => {
                Some([0.5, -0.5].map(|side| Vector3::x() * (side * lens_distance_m)))
            }
            CameraModel::DualFisheye(lenses) => {
                Some(lenses.each_ref().map(|lens| lens.camera_from_lens.translation.vector))
            }
            CameraModel::Stereographic { .. } => None,
        }
    }

    /// Ray of the lens that shows `ray_in_camera`, exact for this camera's distance. `None` where
    /// no lens shows it, or for a camera model with one centre.
    pub fn lens_ray(&self, ray_in_camera: &Ray) -> Option<LensRay> {
        let pixel = self.project(ray_in_camera)?;
        match &self.model {
            CameraModel::Equirectangular { .. } => {
                let ray = self.sphere().ray(pixel);
                let lens = usize::from(ray.x < 0.0);
                Some(LensRay { lens, ray, from_seam_rad: ray.x.abs().min(1.0).asin() })
            }
            CameraModel::DualFisheye(lenses) => {
                let lens = lenses.iter().position(|lens| lens.holds(pixel))?;
                let ray = lenses[lens].camera_from_lens.rotation * lenses[lens].ray(pixel)?;
                let off_axis = |k: usize| {
                    let axis = lenses[k].camera_from_lens.rotation * Vector3::z();
                    axis.dot(ray_in_camera).clamp(-1.0, 1.0).acos()
                };
                let from_seam_rad = (off_axis(1 - lens) - off_axis(lens)) / 2.0;
                Some(LensRay { lens, ray, from_seam_rad })
            }
            CameraModel::Stereographic { .. } => None,
        }
    }
}
