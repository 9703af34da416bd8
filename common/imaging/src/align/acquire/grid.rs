//! The grid of poses that are compared: turns about the line of sight, ranges and shifts.

use std::f64::consts::TAU;

use nalgebra::{UnitQuaternion, Vector3};

/// Blur of the canonical picture, standard deviation, cells.
pub const BLUR_CELLS: f64 = 0.85;
/// The body's middle is looked for so many cells to each side of the place.
pub const REACH_CELLS: usize = 11;
/// Ranges from the stated one, as powers of this. The coarse grid has every second power.
pub const RANGE_STEP: f64 = 1.075;
/// Exponents of the nearest and the farthest range of the coarse grid. A marker that is seen at an angle makes a place
/// seem farther away than it is, the box round one that stands on its corner makes it seem nearer.
pub const RANGE_EXPONENTS: (i32, i32) = (-6, 6);
/// Turns about the line of sight on the fine grid.
pub const TURNS: usize = 48;

/// A pose of the grid, with how well the picture agrees.
#[derive(Debug, Clone, Copy)]
pub struct Cell {
    pub template: usize,
    /// Turn about the line of sight, in fine steps.
    pub turn: usize,
    /// Exponent of the range.
    pub exponent: i32,
    /// Shift of the template in the canonical picture, pixels.
    pub shift: [usize; 2],
    pub score: f32,
}

/// The angle of a turn, radians.
pub fn turn_rad(turn: usize) -> f64 {
    turn as f64 / TURNS as f64 * TAU
}

/// The rotation that leads from the z axis to `sight` by the shortest way.
pub fn lean(sight: &Vector3<f64>) -> UnitQuaternion<f64> {
    // A patch looks ahead, so its pixels never look backwards.
    UnitQuaternion::rotation_between(&Vector3::z(), sight).unwrap_or_default()
}
