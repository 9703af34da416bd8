//! The picture of a place with one pixel for each cell, at each turn and range.

use std::collections::HashMap;
use std::f64::consts::TAU;

use nalgebra::{Isometry3, UnitQuaternion, Vector2, Vector3};

use crate::align::patch::Patch;

/// Blur of the canonical picture, standard deviation, cells.
pub(super) const BLUR_CELLS: f64 = 0.85;
/// Largest distance of the body's middle from the place along each axis, cells.
pub(super) const REACH_CELLS: usize = 11;
/// Ratio of neighbouring ranges. The coarse grid has every second power of it.
const RANGE_STEP: f64 = 1.075;
/// Exponents of the nearest and the farthest range of the coarse grid. Markers at an angle make a
/// place appear farther away. The box around a marker on its corner makes it appear nearer.
pub(super) const RANGE_EXPONENTS: (i32, i32) = (-6, 6);
/// Turns about the line of sight on the fine grid.
pub(super) const TURNS: usize = 48;

/// A pose of the grid, with its score.
#[derive(Debug, Clone, Copy)]
pub(super) struct GridPose {
    pub template: usize,
    /// Turn about the line of sight, in fine steps.
    pub turn: usize,
    pub exponent: i32,
    /// Shift of the template in the canonical picture, pixels.
    pub shift: [usize; 2],
    pub score: f32,
}

/// A canonical picture.
#[derive(Debug)]
pub(super) struct Canvas {
    pub side: usize,
    /// Radiance, row by row, and its square.
    pub radiance: Vec<f32>,
    pub square: Vec<f32>,
    /// The pixels by columns: first the even ones of a row, then the odd ones.
    pub parted: [Vec<f32>; 2],
}

impl Canvas {
    /// A square picture of this radiance.
    pub(super) fn of(side: usize, radiance: Vec<f32>) -> Self {
        let square: Vec<f32> = radiance.iter().map(|value| value * value).collect();
        let parted = [&radiance, &square].map(|plane| part(plane, side));
        Self { side, radiance, square, parted }
    }
}

/// Size and scale of canonical pictures.
#[derive(Debug, Clone, Copy)]
pub(super) struct Size {
    /// Pixels along a side; even, so that a row has as many even columns as odd ones.
    pub side: usize,
    /// The pixel of the body's middle in an unshifted template.
    pub radius: usize,
    pub cell_m: f64,
}

impl Size {
    /// Size for a body with this many cells from its middle to its rim.
    pub(super) fn of(radius: usize, cell_m: f64) -> Self {
        Self { side: 2 * (radius + REACH_CELLS + 1), radius, cell_m }
    }

    /// Pixels along a side of a template.
    pub(super) fn template_side(&self) -> usize {
        2 * self.radius + 1
    }

    /// The place of a pixel in a picture, and in one whose columns are parted.
    pub(super) fn places(&self, x: usize, y: usize) -> [u32; 2] {
        let parted = x % 2 * (self.side / 2) + x / 2;
        [x, parted].map(|column| (y * self.side + column) as u32)
    }
}

/// Canonical pictures of a place, made when they are needed.
#[derive(Debug)]
pub(super) struct Canvases<'p> {
    pub size: Size,
    patch: &'p Patch,
    /// The place in the patch.
    centre_px: Vector2<f64>,
    range_m: f64,
    /// Blur of the lens, pixels of the patch.
    lens_px: f64,
    blurred: HashMap<i32, Patch>,
    made: HashMap<(usize, i32), Canvas>,
}

impl<'p> Canvases<'p> {
    pub(super) fn new(
        size: Size,
        patch: &'p Patch,
        centre_px: Vector2<f64>,
        range_m: f64,
        lens_px: f64,
    ) -> Self {
        let (blurred, made) = (HashMap::new(), HashMap::new());
        Self { size, patch, centre_px, range_m, lens_px, blurred, made }
    }

    /// Range of an exponent, metres.
    fn range_m(&self, exponent: i32) -> f64 {
        self.range_m * RANGE_STEP.powi(exponent)
    }

    /// Pixels of the patch per pixel of the canonical picture.
    fn cell_px(&self, exponent: i32) -> f64 {
        self.size.cell_m / self.range_m(exponent) * self.patch.pinhole.focal_px
    }

    /// Point of the patch for the point `at` of a canonical picture.
    fn in_patch(&self, turn: usize, exponent: i32, at: Vector2<f64>) -> Vector2<f64> {
        let (sin, cos) = turn_rad(turn).sin_cos();
        let off = (at.add_scalar(-self.middle())) * self.cell_px(exponent);
        self.centre_px + Vector2::new(cos * off.x - sin * off.y, sin * off.x + cos * off.y)
    }

    /// The pixel of the place in a canonical picture, along both axes.
    fn middle(&self) -> f64 {
        (self.size.radius + REACH_CELLS) as f64
    }

    /// The picture at a turn and a range.
    pub(super) fn get(&mut self, turn: usize, exponent: i32) -> &Canvas {
        if !self.made.contains_key(&(turn, exponent)) {
            let canvas = self.draw(turn, exponent);
            self.made.insert((turn, exponent), canvas);
        }
        &self.made[&(turn, exponent)]
    }

    fn draw(&mut self, turn: usize, exponent: i32) -> Canvas {
        let Self { patch, lens_px, .. } = *self;
        let wanted_px = BLUR_CELLS * self.cell_px(exponent);
        self.blurred.entry(exponent).or_insert_with(|| {
            let missing_px2 = wanted_px.powi(2) - lens_px.powi(2);
            if missing_px2 > 0.0 { patch.blurred(missing_px2.sqrt()) } else { patch.clone() }
        });
        let blurred = &self.blurred[&exponent];
        let side = self.size.side;
        let corner = self.in_patch(turn, exponent, Vector2::zeros());
        let right = self.in_patch(turn, exponent, Vector2::x()) - corner;
        let down = self.in_patch(turn, exponent, Vector2::y()) - corner;
        let mut radiance = Vec::with_capacity(side * side);
        for y in 0..side {
            let first = corner + down * y as f64;
            radiance.extend((0..side).map(|x| blurred.between(first + right * x as f64)));
        }
        Canvas::of(side, radiance)
    }

    /// The pose of a cell (`patch_from_markers`), whose template shows the body in the attitude
    /// `sight_from_markers`.
    pub(super) fn pose(
        &self,
        sight_from_markers: &UnitQuaternion<f64>,
        cell: &GridPose,
    ) -> Isometry3<f64> {
        let [right, down] = cell.shift.map(|shift| (self.size.radius + shift) as f64);
        let at = self.in_patch(cell.turn, cell.exponent, Vector2::new(right, down));
        let sight = self.patch.pinhole.direction(at).normalize();
        let roll = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), turn_rad(cell.turn));
        Isometry3::from_parts(
            (sight * self.range_m(cell.exponent)).into(),
            lean(&sight) * roll * sight_from_markers,
        )
    }
}

/// The angle of a turn, radians.
fn turn_rad(turn: usize) -> f64 {
    turn as f64 / TURNS as f64 * TAU
}

/// The rotation from the z axis to `sight` by the shortest way.
fn lean(sight: &Vector3<f64>) -> UnitQuaternion<f64> {
    // A patch is ahead, so its pixels never have directions backwards.
    UnitQuaternion::rotation_between(&Vector3::z(), sight).unwrap_or_default()
}

/// The even columns of each row, then the odd ones.
fn part(plane: &[f32], side: usize) -> Vec<f32> {
    let mut parted = Vec::with_capacity(plane.len());
    for row in plane.chunks_exact(side) {
        parted.extend(row.iter().step_by(2));
        parted.extend(row.iter().skip(1).step_by(2));
    }
    parted
}
