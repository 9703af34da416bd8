//! Points of the sphere image.

use nalgebra::Vector2;

/// A point of the sphere image, pixels; (0, 0) is the *centre* of the first pixel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SpherePixel(pub Vector2<f64>);

impl SpherePixel {
    /// The point at column `u`, row `v`.
    pub fn new(u: f64, v: f64) -> Self {
        Self(Vector2::new(u, v))
    }
}
