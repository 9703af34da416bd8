//! A pinhole camera: the directions of a patch's pixels.

use nalgebra::{Vector2, Vector3};

/// A pinhole camera with axes x right, y down, z forward.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Pinhole {
    pub focal_px: f64,
    pub centre_px: Vector2<f64>,
}

impl Pinhole {
    /// The direction of pixel `at`, scaled to depth 1.
    #[inline]
    pub(super) fn direction(&self, at: Vector2<f64>) -> Vector3<f64> {
        ((at - self.centre_px) / self.focal_px).push(1.0)
    }

    /// The pixel of `point`; `None` behind the camera or next to it.
    pub(super) fn project(&self, point: &Vector3<f64>) -> Option<Vector2<f64>> {
        (point.z > 1e-3).then(|| point.xy() / point.z * self.focal_px + self.centre_px)
    }
}
