//! The mapping interpolated over a tile of a view.

use super::angle::{atan, atan2};
use super::mapping::{LANES, Mapping, ONE, fixed, rounded};

/// What interpolation may add to the error of a position, pixels; rounding adds less than the rest
/// of [`super::MAX_MAPPING_ERROR_PX`].
const MAX_INTERPOLATION_ERROR_PX: f64 = 0.012;

/// Most rows of a tile: the rounding of a second difference grows with their square.
pub(super) const MAX_ROWS: u32 = 32;

/// Part of a view: pixels, the first one's place and the sides.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Tile {
    pub x: u32,
    pub y: u32,
    pub width: u32,
    pub height: u32,
}

/// A quadratic in each coordinate: `terms[power of y][power of x]`, 1/65536 px, for x and y that
/// run from -1 to 1 over the tile.
type Quadratic = [[f32; 3]; 3];

/// Positions in the sphere image, relative to that of the tile's middle, over the tile.
#[derive(Debug, Clone, Copy)]
pub(super) struct Patch {
    /// Position of the middle, 1/65536 px; the column may lie one turn off for pixels beyond the
    /// seam.
    middle: [i32; 2],
    /// Columns, then rows.
    terms: [Quadratic; 2],
    /// Half the sides, pixels.
    half_width: f32,
    half_height: f32,
}

/// Positions down `LANES` neighbouring columns of a view, by forward differences.
#[derive(Debug, Clone, Copy)]
pub(super) struct Strip {
    /// Columns, then rows, of the sphere image.
    pub series: [Series; 2],
}

/// For each lane a quadratic sequence, 1/65536 px.
#[derive(Debug, Clone, Copy)]
pub(super) struct Series {
    /// Its first value.
    pub value: [i32; LANES],
    /// Its second value less its first.
    pub step: [i32; LANES],
    /// What each step is longer than the one before.
    pub growth: [i32; LANES],
}

impl Patch {
    /// Interpolates the mapping over `tile`, unless that cannot be done closely enough.
    ///
    /// The error bound of the columns is strict: longitude is the imaginary part of log(w) for
    /// w = x + iy, which runs linearly over the view's plane, so its third derivative along a step
    /// s is at most 2 |s/w|^3. Quadratic interpolation through -1, 0, 1 leaves at most
    /// sqrt(3)/27 of it, and interpolating along the other coordinate as well adds 5/4 of the
    /// other's. The bound of the rows, 1 + 1/|w|^2 in units of the focal length, is
    /// an envelope of what was found over random tiles.
    #[inline(always)]
    pub(super) fn fit(mapping: &Mapping, tile: Tile) -> Option<Self> {
        let (half_width, half_height) = (f64::from(tile.width) * 0.5, f64::from(tile.height) * 0.5);
        let middle = mapping
            .direction(f64::from(tile.x) + half_width - 0.5, f64::from(tile.y) + half_height - 0.5);
        let (right, down) = (mapping.right * half_width, mapping.down * half_height);

        let radius = length(middle.x, middle.y);
        let (reach_x, reach_y) = (length(right.x, right.y), length(down.x, down.y));
        let nearest = radius - reach_x - reach_y;
        // Farther from the pole than wide: angles from the middle stay below 45 degrees.
        if nearest <= radius * 0.5 {
            return None;
        }
        let remainder = |x: f64, y: f64| 3f64.sqrt() / 27.0 * (x.powi(3) + 1.25 * y.powi(3));
        let column_error =
            2.0 * mapping.columns_per_radian() * remainder(reach_x / nearest, reach_y / nearest);
        let near = (nearest / mapping.focal_px).min(1.0);
        let row_error = (1.0 + 1.0 / (near * near))
            * mapping.rows_per_radian()
            * remainder(half_width / mapping.focal_px, half_height / mapping.focal_px);
        if column_error > MAX_INTERPOLATION_ERROR_PX || row_error > MAX_INTERPOLATION_ERROR_PX {
            return None;
        }

        // Twelve, not nine: whole vectors of four. The last three repeat the middle.
        const ACROSS: [f64; 12] = [-1., 0., 1., -1., 0., 1., -1., 0., 1., 0., 0., 0.];
        const ALONG: [f64; 12] = [-1., -1., -1., 0., 0., 0., 1., 1., 1., 0., 0., 0.];
        let mut columns = [0.0; 12];
        let mut rows = [0.0; 12];
        let column_scale = -mapping.columns_per_radian() * ONE;
        let row_scale = -mapping.rows_per_radian() * ONE;
        for k in 0..12 {
            let dx = right.x * ACROSS[k] + down.x * ALONG[k];
            let dy = right.y * ACROSS[k] + down.y * ALONG[k];
            let dz = right.z * ACROSS[k] + down.z * ALONG[k];
            // Angles from the middle's longitude and latitude: arguments of complex quotients.
            let turned = dy * middle.x - dx * middle.y;
            let ahead = radius * radius + dx * middle.x + dy * middle.y;
            columns[k] = column_scale * atan(turned / ahead);
            let (x, y, z) = (middle.x + dx, middle.y + dy, middle.z + dz);
            let across = length(x, y);
            let risen = z * radius - across * middle.z;
            let level = across * radius + z * middle.z;
            rows[k] = row_scale * atan(risen / level);
        }
        let longitude = atan2(middle.y, middle.x);
        let latitude = atan2(middle.z, radius);
        let centre = (
            mapping.columns_per_radian() * (std::f64::consts::PI - longitude) - 0.5,
            mapping.rows_per_radian() * (std::f64::consts::FRAC_PI_2 - latitude) - 0.5,
        );
        Some(Self {
            middle: [fixed(centre.0), fixed(centre.1)],
            terms: [quadratic(&columns), quadratic(&rows)],
            half_width: half_width as f32,
            half_height: half_height as f32,
        })
    }

    /// Positions down the `LANES` columns from column `first` of the tile on.
    #[inline(always)]
    pub(super) fn strip(&self, first: u32) -> Strip {
        Strip { series: [self.series(0, first), self.series(1, first)] }
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
            // What is lost of the growth by rounding is lost of the whole quadratic, which is
            // taken about the middle, so that it matters least.
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
    /// Whether every one of the first `rows` values lies in 0 ..= `last`, in 1/65536 px; `false`
    /// may be said of some that do.
    #[inline(always)]
    pub(super) fn stays_within(&self, rows: i32, last: i32) -> bool {
        let steps = rows - 1;
        let mut is_inside = true;
        for k in 0..LANES {
            let (value, step, growth) = (self.value[k], self.step[k], self.growth[k]);
            // So small that nothing below overflows: 32 rows of 32 px, bent by as much.
            let is_tame = step.unsigned_abs() < 1 << 21 && growth.unsigned_abs() < 1 << 16;
            let end = value
                .wrapping_add(step.wrapping_mul(steps))
                .wrapping_add(growth.wrapping_mul(steps * (steps - 1) / 2));
            // A parabola leaves its chord by at most growth (n/2)^2 / 2.
            let bulge = growth.wrapping_abs().wrapping_mul(rows * rows / 8 + 1);
            is_inside &=
                is_tame & (value.min(end) >= bulge) & (value.max(end) <= last.wrapping_sub(bulge));
        }
        is_inside
    }

    /// Goes on by one row.
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
fn quadratic(values: &[f64; 12]) -> Quadratic {
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

#[inline(always)]
fn length(x: f64, y: f64) -> f64 {
    (x * x + y * y).sqrt()
}
