//! Pixels in which a camera does not see the outside: beyond its image circles, and on the own
//! airframe.

use crate::Ray;
use crate::camera::{Camera, CameraError};
use crate::view::{View, ViewPixel};

/// The parts of a camera's image that show the outside.
#[derive(Debug, Clone, PartialEq)]
pub struct Mask {
    camera: Camera,
    /// Whether each pixel shows the outside, row by row; empty where all do.
    seen: Vec<bool>,
}

/// Largest distance between two tested points of a view, pixels. A smaller gap contains no marker.
const STEP_PX: u32 = 12;

impl Mask {
    /// Mask that hides only the area beyond the camera's image circles.
    pub fn nothing_hidden(camera: Camera) -> Self {
        Self { camera, seen: Vec::new() }
    }

    /// Mask from the pixels of an image of `sides` (columns, rows), row by row: `false` hides.
    ///
    /// # Errors
    /// Sides that differ from the camera's.
    pub fn new(camera: Camera, sides: [u32; 2], seen: Vec<bool>) -> Result<Self, CameraError> {
        let frame = [camera.width(), camera.height()];
        let pixels = frame[0] as usize * frame[1] as usize;
        if sides != frame || seen.len() != pixels {
            return Err(CameraError::MaskSides { mask: sides, frame });
        }
        Ok(Self { camera, seen })
    }

    /// Whether the camera sees nothing along `ray_in_camera`.
    pub fn hides(&self, ray_in_camera: &Ray) -> bool {
        let Some(at) = self.camera.project(ray_in_camera) else { return true };
        if self.seen.is_empty() {
            return false;
        }
        // Pixel with the nearest middle; positions reach half a pixel over the borders.
        let nearest = |at: f64, side: u32| (at.round().max(0.0) as usize).min(side as usize - 1);
        let column = nearest(at.0.x, self.camera.width());
        let row = nearest(at.0.y, self.camera.height());
        !self.seen[row * self.camera.width() as usize + column]
    }

    /// Whether the camera sees nothing anywhere in `view`.
    pub fn hides_view(&self, view: &View) -> bool {
        let last = f64::from(view.size_px) - 1.0;
        let steps = view.size_px.div_ceil(STEP_PX).max(1);
        let place = |k: u32| last * f64::from(k) / f64::from(steps);
        (0..=steps)
            .all(|y| (0..=steps).all(|x| self.hides(&view.ray(ViewPixel::new(place(x), place(y))))))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use nalgebra::{Unit, Vector3};

    use super::*;
    use crate::camera::CameraModel;

    fn lower_half_hidden() -> Mask {
        let camera = Camera::equirectangular(128, 64);
        let seen = (0..128 * 64).map(|k| k / 128 < 32).collect();
        Mask::new(camera, [128, 64], seen).unwrap()
    }

    #[test]
    fn only_views_wholly_inside_are_hidden() {
        let mask = lower_half_hidden();
        let look = |z: f64, field_deg: f64| {
            let direction = Unit::new_normalize(Vector3::new(0.3, -1.0, z));
            View::looking_at(&direction, f64::to_radians(field_deg), 301)
        };
        assert!(mask.hides_view(&look(-2.0, 60.0)));
        assert!(!mask.hides_view(&look(-0.5, 60.0)));
        assert!(!mask.hides_view(&look(1.0, 60.0)));
        assert!(mask.hides_view(&look(-0.5, 30.0)));
    }

    #[test]
    fn without_a_mask_only_the_circles_hide() {
        let camera = Camera::equirectangular(128, 64);
        assert!(!Mask::nothing_hidden(camera).hides(&-Vector3::z_axis()));
        let plane = CameraModel::Stereographic { field_rad: 200f64.to_radians() };
        let mask = Mask::nothing_hidden(Camera::new(640, 640, plane).unwrap());
        let behind = View::looking_at(&-Vector3::x_axis(), 1.0, 200);
        let aside = View::looking_at(&Vector3::y_axis(), 1.0, 200);
        assert!(mask.hides_view(&behind) && !mask.hides_view(&aside));
    }

    #[test]
    fn masks_of_other_sizes_are_refused() {
        let camera = Camera::equirectangular(128, 64);
        let error = Mask::new(camera, [64, 32], vec![true; 2048]).unwrap_err();
        assert!(error.to_string().contains("64x32 pixels, frames have 128x64"), "{error}");
        assert!(Mask::new(camera, [128, 64], vec![true; 7]).is_err());
    }
}
