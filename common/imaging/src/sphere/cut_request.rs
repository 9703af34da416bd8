//! Request to cut a view.

use flockeye_geometry::camera::Camera;
use flockeye_geometry::view::View;

use super::error::{MAX_SIDE_PX, SphereError};

/// A view to be cut.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cut {
    /// The view.
    pub view: View,
    /// The distance for which it is exact, metres; see [`Camera::at_distance`].
    pub distance_m: f64,
    /// Interpolation between pixels.
    pub interpolation: Interpolation,
}

/// Computation of the grey value between pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Interpolation {
    /// From the four pixels around it.
    #[default]
    Bilinear,
    /// From the sixteen pixels around it, by the cubic convolution that is exact for parabolas
    /// (Keys: *Cubic convolution interpolation for digital image processing*, 1981; Catmull-Rom).
    /// It is sharper where a view is magnified, at about three times the cost.
    Cubic,
}

/// Magnification, relative to the sphere image, above which views benefit from cubic interpolation.
pub const MAGNIFIED: f64 = 1.25;

impl Interpolation {
    /// Cubic for magnified views, bilinear for others.
    pub fn suited_to(view: &View, camera: &Camera) -> Self {
        if view.focal_px > MAGNIFIED * camera.pixels_per_radian() {
            Self::Cubic
        } else {
            Self::Bilinear
        }
    }
}

impl Cut {
    /// A view of distant objects, interpolated bilinearly.
    pub fn bilinear(view: View) -> Self {
        Self { view, distance_m: f64::INFINITY, interpolation: Interpolation::Bilinear }
    }

    /// A view of distant objects, interpolated by the cubic.
    pub fn cubic(view: View) -> Self {
        Self { interpolation: Interpolation::Cubic, ..Self::bilinear(view) }
    }

    /// Refuses a view without content.
    pub fn check(&self) -> Result<(), SphereError> {
        let View { camera_from_view, focal_px, size_px } = self.view;
        // A comparison with NaN is false, so NaN is refused too.
        let is_unit = (camera_from_view.norm() - 1.0).abs() < 1e-3;
        let is_lens = focal_px > 0.0 && focal_px.is_finite();
        if !is_unit || !is_lens || !(1..=MAX_SIDE_PX).contains(&size_px) {
            return Err(SphereError::View { size_px, focal_px });
        }
        Ok(())
    }
}
