//! The mapping interpolated over a tile of a view.

use super::fixed_point::{LANES, ONE, fixed, rounded};

/// Largest interpolation error of a position, pixels. Rounding adds less than the rest of
/// [`super::fixed_point::MAX_MAPPING_ERROR_PX`].
pub(super) const MAX_INTERPOLATION_ERROR_PX: f64 = 0.012;

/// Number of nodes: whole vectors of four, so the last three repeat the middle.
pub(super) const NODE_COUNT: usize = 12;

/// Nodes of a tile, relative to its middle in halves of its sides: across, then along.
pub(super) const NODES: [[f64; NODE_COUNT]; 2] = [
    [-1., 0., 1., -1., 0., 1., -1., 0., 1., 0., 0., 0.],
    [-1., -1., -1., 0., 0., 0., 1., 1., 1., 0., 0., 0.],
];

/// Most rows of a tile: rounding errors of a second difference grow with their square.
pub(super) const MAX_ROWS: u32 = 32;

/// A rectangle of a view: its first pixel and its sides, pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct ViewTile {
    pub x: u32,
    pub y: u32,
    pub width: u32,
    pub height: u32,
}

/// A quadratic in each coordinate: `terms[power of y][power of x]`, 1/65536 px, for x and y from -1
/// to 1 over the tile.
type Quadratic = [[f32; 3]; 3];

/// Positions in the sphere image over a tile, relative to that of the tile's middle.
#[derive(Debug, Clone, Copy)]
pub(super) struct TilePositions {
    /// Position of the middle, 1/65536 px; the column may be off by one turn beyond the seam.
    middle: [i32; 2],
    /// Columns, then rows.
    terms: [Quadratic; 2],
    /// Half the sides, pixels.
    half_width: f32,
    half_height: f32,
}

/// Columns, then rows, of the sphere image along `LANES` columns of a view.
pub(super) type Strip = [Series; 2];

/// A quadratic sequence for each lane, 1/65536 px.
#[derive(Debug, Clone, Copy)]
pub(super) struct Series {
    /// The first value.
    pub value: [i32; LANES],
    /// The second value minus the first.
    pub step: [i32; LANES],
    /// The second difference: growth of the step from one value to the next.
    pub growth: [i32; LANES],
}

impl TilePositions {
    /// The quadratic through the positions at the [`NODES`] of `tile`. `columns` and `rows` are
    /// relative to `middle`, the position of the middle in pixels.
    #[inline(always)]
    pub(super) fn through(
        tile: ViewTile,
        middle: (f64, f64),
        columns: &[f64; NODE_COUNT],
        rows: &[f64; NODE_COUNT],
    ) -> Self {
        Self {
            middle: [fixed(middle.0), fixed(middle.1)],
            terms: [quadratic(columns), quadratic(rows)],
            half_width: (f64::from(tile.width) * 0.5) as f32,
            half_height: (f64::from(tile.height) * 0.5) as f32,
        }
    }

    /// Position of a point of the tile relative to that of its middle, pixels. The point is given
    /// in halves of the tile's sides.
    pub(super) fn offset_px(&self, across: f64, along: f64) -> [f64; 2] {
        self.terms.map(|terms| {
            let [constant, linear, square] = terms
                .map(|[c, l, s]| f64::from(c) + across * (f64::from(l) + across * f64::from(s)));
            (constant + along * (linear + along * square)) / ONE
        })
    }

    /// Positions along the `LANES` columns from column `first` of the tile on.
    #[inline(always)]
    pub(super) fn strip(&self, first: u32) -> Strip {
        [self.series(0, first), self.series(1, first)]
    }

    #[inline(always)]
    fn series(&self, coordinate: usize, first: u32) -> Series {
        let [constant, linear, square] = &self.terms[coordinate];
        let (top, per_row) = (0.5 - self.half_height, 1.0 / self.half_height);
        let mut series = Series { value: [0; LANES], step: [0; LANES], growth: [0; LANES] };
        for k in 0..LANES {
            let x = (first as f32 + k as f32 + 0.5 - self.half_width) / self.half_width;
            let at = |terms: &[f32; 3]| terms[0] + x * (terms[1] + x * terms[2]);
            let slope = at(linear) * per_row;
            // The second difference is rounded first, and the other terms are computed with the
            // rounded one, about the middle, where the error matters least.
            let growth = rounded(f64::from(2.0 * at(square) * (per_row * per_row)));
            let bend = growth as f32;
            let value = at(constant) + top * (slope + 0.5 * bend * top);
            let step = slope + bend * (top + 0.5);
            series.value[k] = self.middle[coordinate].wrapping_add(rounded(f64::from(value)));
            series.step[k] = rounded(f64::from(step));
            series.growth[k] = growth;
        }
        series
    }
}

impl Series {
    /// Whether all of the first `rows` values certainly lie in `first` ..= `last`, 1/65536 px. The
    /// result may be `false` although they do.
    #[inline(always)]
    pub(super) fn stays_within(&self, rows: i32, [first, last]: [i32; 2]) -> bool {
        let steps = rows - 1;
        let mut is_inside = true;
        for k in 0..LANES {
            let (value, step, growth) = (self.value[k], self.step[k], self.growth[k]);
            // Limits within which nothing below overflows: 32 rows of 32 px, with a curvature of as
            // much.
            let is_small = step.unsigned_abs() < 1 << 21 && growth.unsigned_abs() < 1 << 16;
            let end = value
                .wrapping_add(step.wrapping_mul(steps))
                .wrapping_add(growth.wrapping_mul(steps * (steps - 1) / 2));
            // A parabola is at most growth (n/2)^2 / 2 away from its chord.
            let bulge = growth.wrapping_abs().wrapping_mul(rows * rows / 8 + 1);
            is_inside &= is_small
                & (value.min(end) >= first.wrapping_add(bulge))
                & (value.max(end) <= last.wrapping_sub(bulge));
        }
        is_inside
    }

    /// Advances by one row.
    #[inline(always)]
    pub(super) fn advance(&mut self) {
        for k in 0..LANES {
            self.value[k] = self.value[k].wrapping_add(self.step[k]);
            self.step[k] = self.step[k].wrapping_add(self.growth[k]);
        }
    }
}

/// The quadratic through values at x, y = -1, 0, 1, x fastest.
#[inline(always)]
fn quadratic(values: &[f64; NODE_COUNT]) -> Quadratic {
    let through = |a: f64, b: f64, c: f64| -> [f64; 3] { [b, (c - a) * 0.5, (a + c) * 0.5 - b] };
    let above = through(values[0], values[1], values[2]);
    let level = through(values[3], values[4], values[5]);
    let below = through(values[6], values[7], values[8]);
    let mut terms = [[0.0; 3]; 3];
    for k in 0..3 {
        let down = through(above[k], level[k], below[k]);
        for (power, term) in down.into_iter().enumerate() {
            terms[power][k] = term as f32;
        }
    }
    terms
}
