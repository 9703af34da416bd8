//! One side of a marker in the view.

use flockeye_geometry::view::ViewPixel;
use nalgebra::Vector2;

/// Position and direction of one side of a guessed marker.
#[derive(Debug, Clone, Copy)]
pub(super) struct SideFrame {
    /// Middle of the side, in the view.
    pub middle: Vector2<f64>,
    /// Unit vector from the first corner to the second.
    pub along: Vector2<f64>,
    /// Unit vector into the marker.
    pub inward: Vector2<f64>,
    /// Half the length of the side, pixels.
    pub half: f64,
}

impl SideFrame {
    /// The side from corner `k` to the next.
    pub(super) fn of(corners: &[ViewPixel; 4], k: usize) -> Self {
        let (from, to) = (corners[k].0, corners[(k + 1) % 4].0);
        let along = (to - from).normalize();
        let inward = Vector2::new(-along.y, along.x);
        Self { middle: (from + to) / 2.0, along, inward, half: (to - from).norm() / 2.0 }
    }
}
