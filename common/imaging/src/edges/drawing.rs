//! Renders a print on a grid of pixels, blurred by a Gaussian.

use nalgebra::{Matrix2, Matrix3, Vector2, Vector3};

use super::print::MarkerPrint;

/// Every `step`-th pixel of a view: column x, row y of the grid is the pixel
/// (left + x * step, top + y * step).
#[derive(Debug, Clone, Copy)]
pub(super) struct Grid {
    pub left: usize,
    pub top: usize,
    pub columns: usize,
    pub rows: usize,
    pub step: usize,
}

impl Grid {
    /// The pixel of a grid point.
    pub(super) fn at(&self, column: usize, row: usize) -> (usize, usize) {
        (self.left + column * self.step, self.top + row * self.step)
    }
}

/// The share of white at each grid point, row by row, and its derivatives by x and y, per pixel.
#[derive(Debug)]
pub(super) struct Drawing {
    pub white: Vec<f32>,
    pub by_x: Vec<f32>,
    pub by_y: Vec<f32>,
    /// The print without blur, with a rim. Kept to reuse its memory.
    sharp: Vec<f32>,
    /// White (1) or black (0) of every cell, with one row of white cells around.
    cells: Vec<f32>,
    /// Cells along a side.
    count: usize,
}

/// Width above which a Gaussian is summed over one point for each grid point, steps of the grid.
/// Narrower ones are summed over four. Then an edge moves by less than 0.01 steps with the phase of
/// the grid.
const WIDE_STEPS: f64 = 0.85;

/// Radius at which Gaussians are truncated, standard deviations.
const REACH: f64 = 3.1;

/// The mean of `count` x `count` cells with a rim, over a rectangle of `width` by `height` about
/// the point (`a`, `b`), all in cells. The rectangle must not be larger than a cell.
fn mean(cells: &[f32], count: usize, (a, b): (f32, f32), width: f32, height: f32) -> f32 {
    let last = count as f32 + 0.49;
    let (before, share) = nearest_edge(a.clamp(-0.5, last), width);
    let (above, lower) = nearest_edge(b.clamp(-0.5, last), height);
    let first = above * (count + 2) + before;
    let row = |first: usize| cells[first] + share * (cells[first + 1] - cells[first]);
    let upper = row(first);
    upper + lower * (row(first + count + 2) - upper)
}

/// The cell before the edge nearest to `at`, counted from the row around the square. Also returns
/// the share of a box of this width about `at` that lies behind the edge.
fn nearest_edge(at: f32, width: f32) -> (usize, f32) {
    let edge = (at + 0.5).floor();
    (edge as usize, ((at - edge) / width + 0.5).clamp(0.0, 1.0))
}

impl Drawing {
    /// Creates a drawing of `print` before its first rendering.
    pub(super) fn of(print: &MarkerPrint) -> Self {
        let count = print.cells();
        let last = count as isize;
        let cells = (-1..=last).flat_map(|row| {
            (-1..=last).map(move |column| f32::from(u8::from(print.is_white(row, column))))
        });
        let [white, by_x, by_y, sharp] = [const { Vec::new() }; 4];
        Self { white, by_x, by_y, sharp, cells: cells.collect(), count }
    }

    /// Renders the print on a grid. `cells_from_view` maps pixels to cells, `blur` is the
    /// Gaussian's covariance in pixels squared. `None` if the covariance is singular.
    pub(super) fn draw(
        &mut self,
        grid: &Grid,
        cells_from_view: &Matrix3<f64>,
        blur: &Matrix2<f64>,
    ) -> Option<()> {
        let in_steps = blur / (grid.step * grid.step) as f64;
        let spread = in_steps.symmetric_eigenvalues();
        let phases = if spread.min().sqrt() < WIDE_STEPS { 2 } else { 1 };
        let rim = (REACH * spread.max().sqrt()).ceil() as usize;
        let inverse = in_steps.try_inverse()?;
        let size = grid.columns * grid.rows;
        for plane in [&mut self.white, &mut self.by_x, &mut self.by_y] {
            plane.clear();
            plane.resize(size, 0.0);
        }
        // The kernels of all phases sum up to one.
        let offset = |phase: usize| (phase as f64 + 0.5) / phases as f64 - 0.5;
        let reach = rim as isize;
        let mut total = 0.0;
        for (y, x) in (0..phases).flat_map(|y| (0..phases).map(move |x| (y, x))) {
            for (j, i) in (-reach..=reach).flat_map(|j| (-reach..=reach).map(move |i| (j, i))) {
                let by = Vector2::new(i as f64 + offset(x), j as f64 + offset(y));
                total += (-0.5 * (inverse * by).dot(&by)).exp();
            }
        }
        for (phase_y, phase_x) in (0..phases).flat_map(|y| (0..phases).map(move |x| (y, x))) {
            let offset = Vector2::new(offset(phase_x), offset(phase_y));
            self.draw_sharp(grid, cells_from_view, rim, offset, 1.0 / phases as f64);
            let width = grid.columns + 2 * rim;
            for j in -reach..=reach {
                for i in -reach..=reach {
                    let by = Vector2::new(i as f64, j as f64) + offset;
                    let slope = inverse * by;
                    let weight = (-0.5 * slope.dot(&by)).exp() / total;
                    if weight < 1e-5 {
                        continue;
                    }
                    let slope = slope * (weight / grid.step as f64);
                    let taps = [weight as f32, slope.x as f32, slope.y as f32];
                    let first = (j + reach) as usize * width + (i + reach) as usize;
                    self.add(grid, width, first, taps);
                }
            }
        }
        Some(())
    }

    /// Adds the print without blur, shifted to begin at `first`, to the three images, weighted by
    /// `taps`.
    fn add(&mut self, grid: &Grid, width: usize, first: usize, taps: [f32; 3]) {
        let columns = grid.columns;
        for row in 0..grid.rows {
            let source = &self.sharp[first + row * width..][..columns];
            let out = row * columns..(row + 1) * columns;
            let white = &mut self.white[out.clone()];
            let (by_x, by_y) = (&mut self.by_x[out.clone()], &mut self.by_y[out]);
            for k in 0..columns {
                white[k] += taps[0] * source[k];
                by_x[k] += taps[1] * source[k];
                by_y[k] += taps[2] * source[k];
            }
        }
    }

    /// Renders the print without blur at the grid points and a rim of `rim` points around them, all
    /// shifted by `offset` steps. Each point is the mean over `share` of a step.
    fn draw_sharp(
        &mut self,
        grid: &Grid,
        cells_from_view: &Matrix3<f64>,
        rim: usize,
        offset: Vector2<f64>,
        share: f64,
    ) {
        let step = grid.step as f64;
        let place = |x: f64, y: f64| {
            let (x, y) = (x - rim as f64 + offset.x, y - rim as f64 + offset.y);
            cells_from_view
                * Vector3::new(grid.left as f64 + x * step, grid.top as f64 + y * step, 1.0)
        };
        let (columns, rows) = (grid.columns + 2 * rim, grid.rows + 2 * rim);
        // The boxes are as large as in the middle of the grid.
        let cell = |p: Vector3<f64>| p.xy() / p.z;
        let (x, y) = (columns as f64 / 2.0, rows as f64 / 2.0);
        let right = cell(place(x + 0.5, y)) - cell(place(x - 0.5, y));
        let down = cell(place(x, y + 0.5)) - cell(place(x, y - 0.5));
        let box_of = |k: usize| (share * right[k].hypot(down[k])).clamp(1e-3, 1.0) as f32;
        let (wide, high) = (box_of(0), box_of(1));
        let across = place(1.0, 0.0) - place(0.0, 0.0);
        let Self { sharp, cells, count, .. } = self;
        sharp.clear();
        sharp.reserve(columns * rows);
        for y in 0..rows {
            let mut at = place(0.0, y as f64);
            for _ in 0..columns {
                let over = 1.0 / at.z;
                let at_cell = ((at.x * over) as f32, (at.y * over) as f32);
                sharp.push(mean(cells, *count, at_cell, wide, high));
                at += across;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;
    use crate::gaussian::density_and_distribution;

    /// A black square of six cells, 18.6 px wide.
    #[test]
    fn a_black_square_is_rendered_as_its_closed_form() {
        let print = MarkerPrint::of_bits(&[false; 16]).unwrap();
        let (size, left) = (18.6, 5.3);
        let cells_from_view = Matrix3::new(
            6.0 / size,
            0.0,
            -left * 6.0 / size,
            0.0,
            6.0 / size,
            -left * 6.0 / size,
            0.0,
            0.0,
            1.0,
        );
        let mut drawing = Drawing::of(&print);
        for step in [1, 2] {
            for sigma in [0.9, 1.2, 2.0].map(|sigma| sigma * step as f64) {
                let grid = Grid { left: 0, top: 0, columns: 15, rows: 15, step };
                let blur = Matrix2::from_diagonal_element(sigma * sigma);
                drawing.draw(&grid, &cells_from_view, &blur).unwrap();
                // A grid point is the mean over a step, which blurs too.
                let sigma = sigma.hypot(step as f64 / 12f64.sqrt());
                // A blurred interval along one coordinate, and its derivative.
                let black = |at: usize| {
                    let depth = (at * step) as f64 - left;
                    let (near, far) = (
                        density_and_distribution(depth / sigma),
                        density_and_distribution((depth - size) / sigma),
                    );
                    (near.1 - far.1, (near.0 - far.0) / sigma)
                };
                for (k, (row, column)) in
                    (0..15).flat_map(|row| (0..15).map(move |column| (row, column))).enumerate()
                {
                    let ((x, by_x), (y, by_y)) = (black(column), black(row));
                    for (drawn, exact) in [
                        (drawing.white[k], 1.0 - x * y),
                        (drawing.by_x[k], -by_x * y),
                        (drawing.by_y[k], -by_y * x),
                    ] {
                        let error = f64::from(drawn) - exact;
                        assert!(error.abs() < 0.03, "{row} {column} {sigma} {step}: {error}");
                    }
                }
            }
        }
    }
}
