//! Fits the whole print to the pixels.
//!
//! On a small marker, the position of an outer edge depends on its blurred neighbours: the border's
//! inner edge, and the unknown surroundings beyond the quiet zone. But the marker was decoded, so
//! all of its cells are known. The edges between cells are as good as the outer ones, with nothing
//! unknown behind them. The radiance of a pixel is
//!
//! ```text
//! I = B + (W - B) M + sum over the sides k of A_k F((d_k - q) / s_k)
//! ```
//!
//! | symbol | meaning |
//! | --- | --- |
//! | W, B | radiance of white and of black |
//! | M | share of white of the print, seen through a homography and blurred ([`super::drawing`]) |
//! | A_k | how much the surroundings beyond side k's quiet zone differ from W |
//! | d_k, q | distance of the pixel from side k, and of the end of the quiet zone |
//! | s_k | standard deviation of the blur across side k |
//! | F | Gaussian distribution function |
//!
//! There are seventeen unknowns: eight of the homography, three of the blur's covariance, W, B and
//! four A_k. They are found by Gauss-Newton with Cauchy weights.

mod sums;

use flockeye_geometry::view::ViewPixel;
use nalgebra::{Matrix2, Matrix3, SMatrix, SVector, Vector2, Vector3};

use super::corners::RefinedCorners;
use super::drawing::{Drawing, Grid};
use super::grain::Grain;
use super::model::quantile;
use super::print::{MarkerPrint, QUIET_ZONE_CELLS};
use super::profile::CLIPPED_CODE;
use crate::gaussian::density_and_distribution;
use crate::image::LumaImage;
use crate::light::LinearLight;
use crate::occluded::{least_residual, mark_disc, reach_px};
use crate::square::SquareInView;
use sums::{ROOM, RobustSums, UNKNOWNS, Unknowns};

/// Number of unknowns of the homography, which come first: those of a projective map of the
/// square's own plane.
const PLACE: usize = 8;
const BLUR: usize = 8;
const WHITE: usize = 11;
const BLACK: usize = 12;
const BEYOND: usize = 13;

const ITERATIONS: usize = 10;
/// Largest motion of a corner below which a step is the last, steps of the grid.
const CONVERGED: f64 = 0.02;
/// Narrowest blur, steps of the grid. It cannot be distinguished from the width of a pixel.
const MIN_BLUR: f64 = 0.4;

/// Values of the unknowns.
#[derive(Debug, Clone, Copy)]
struct State {
    /// Homography from the square's plane, with its middle at the origin and sides of 1, to the
    /// view.
    view_from_square: Matrix3<f64>,
    /// Covariance of the blur, pixels squared.
    blur: Matrix2<f64>,
    white: f64,
    black: f64,
    beyond: [f64; 4],
}

/// Largest hidden share of the print. Beyond it the state must be wrong.
const MAX_HIDDEN_SHARE: f64 = 0.5;

const CORNERS: [(f64, f64); 4] = [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)];

impl State {
    /// Start state with the corners from the edges. `None` where these form no square.
    fn of(edges: &RefinedCorners) -> Option<Self> {
        let to_unit = Matrix3::new(1.0, 0.0, 0.5, 0.0, 1.0, 0.5, 0.0, 0.0, 1.0);
        let view_from_square =
            SquareInView::new(&edges.corners_in_view)?.view_from_square * to_unit;
        let [a, b] = edges.blur_px.map(|blur| blur * blur);
        let blur = Matrix2::from_diagonal_element((a + b) / 2.0);
        let (white, black) = (edges.white, edges.black);
        Some(Self { view_from_square, blur, white, black, beyond: [0.0; 4] })
    }

    fn corners(&self) -> [ViewPixel; 4] {
        CORNERS.map(|(p, q)| ViewPixel(cartesian(self.view_from_square * Vector3::new(p, q, 1.0))))
    }

    /// Derivative of a point in the view by the point (p, q) of the square's plane.
    fn jacobian(&self, (p, q): (f64, f64)) -> Matrix2<f64> {
        let homography = &self.view_from_square;
        let at = homography * Vector3::new(p, q, 1.0);
        let (x, y, w) = (at.x / at.z, at.y / at.z, at.z);
        Matrix2::new(
            (homography[(0, 0)] - x * homography[(2, 0)]) / w,
            (homography[(0, 1)] - x * homography[(2, 1)]) / w,
            (homography[(1, 0)] - y * homography[(2, 0)]) / w,
            (homography[(1, 1)] - y * homography[(2, 1)]) / w,
        )
    }

    /// The state after a step, limited to the range in which the model is about linear.
    fn after(&self, step: &Unknowns) -> Self {
        let change = Matrix3::new(
            1.0 + step[0],
            step[1],
            step[2],
            step[3],
            1.0 + step[4],
            step[5],
            step[6],
            step[7],
            1.0,
        );
        let contrast = self.white - self.black;
        let bounded = |index: usize, most: f64| step[index].clamp(-most, most);
        // The limit of the derivatives by the blur.
        let most = 0.3 * self.blur.trace() / 2.0;
        let turn = Matrix2::new(
            bounded(BLUR, most),
            bounded(BLUR + 1, most),
            bounded(BLUR + 1, most),
            bounded(BLUR + 2, most),
        );
        Self {
            view_from_square: self.view_from_square * change,
            blur: self.blur + turn,
            white: self.white + bounded(WHITE, 0.5 * contrast),
            black: self.black + bounded(BLACK, 0.5 * contrast),
            beyond: std::array::from_fn(|k| self.beyond[k] + step[BEYOND + k]),
        }
    }
}

fn cartesian(point: Vector3<f64>) -> Vector2<f64> {
    point.xy() / point.z
}

/// Derivatives by the homography's unknowns; `gradient` is the derivative by the square's point (p,
/// q).
fn by_place(gradient: Vector2<f64>, (p, q): (f64, f64)) -> [f64; PLACE] {
    let (by_p, by_q) = (gradient.x, gradient.y);
    let inwards = -(by_p * p + by_q * q);
    [by_p * p, by_p * q, by_p, by_q * p, by_q * q, by_q, inwards * p, inwards * q]
}

/// The pixels to which a marker is fitted.
struct PrintView<'a> {
    image: &'a LumaImage<'a>,
    light: &'a LinearLight,
    /// Cells of the print along a side.
    cells: usize,
    grid: Grid,
    /// Whether an object hides the print at each pixel of the grid. Empty if none does.
    hidden: Vec<bool>,
    /// Distance from the square within which pixels are used, sides of the square.
    reach: f64,
    /// Possible end of the quiet zone, sides of the square from its edge.
    quiet: f64,
    contrast: f64,
}

/// Fits the print, starting from its `edges`. `None` where it does not fit, or the image cuts it.
pub(super) fn fit(
    image: &LumaImage<'_>,
    light: &LinearLight,
    edges: &RefinedCorners,
    print: &MarkerPrint,
    grain: Grain,
) -> Option<RefinedCorners> {
    let start = State::of(edges)?;
    let cells = print.cells();
    let side = 1.0 / cells as f64;
    let reach = QUIET_ZONE_CELLS * side;
    let step = grain.step(start.blur.symmetric_eigenvalues().min().sqrt());
    let grid = grid(image, &start, reach, step)?;
    let mut view = PrintView {
        image,
        light,
        cells,
        grid,
        hidden: Vec::new(),
        reach,
        quiet: (QUIET_ZONE_CELLS + QUIET_MARGIN_CELLS) * side,
        contrast: (start.white - start.black).max(1e-6),
    };
    let mut drawing = Drawing::of(print);
    let mut converged = converge(&view, start, 0.1 * view.contrast, &mut drawing)?;
    let mut sums = view.sum(&converged.0, converged.1, &mut drawing, true)?;
    view.hidden = view.hidden(&sums, converged);
    if !view.hidden.is_empty() {
        converged = converge(&view, converged.0, converged.1, &mut drawing)?;
        sums = view.sum(&converged.0, converged.1, &mut drawing, true)?;
    }
    result(&view, converged, &sums, grain)
}

/// Gauss-Newton from a state and a standard deviation of the residuals. Returns both at the end;
/// `None` where the result is no print.
fn converge(
    view: &PrintView<'_>,
    start: State,
    start_noise: f64,
    drawing: &mut Drawing,
) -> Option<(State, f64)> {
    let (mut state, mut noise) = (start, start_noise);
    let noise_of = |sizes: Vec<f64>| -> Option<f64> {
        Some((1.4826 * quantile(sizes, 0.5)?).max(0.002 * view.contrast))
    };
    for _ in 0..ITERATIONS {
        let sums = view.sum(&state, noise, drawing, false)?;
        let step = sums.normal().cholesky()?.solve(&sums.gradient);
        noise = noise_of(sums.sizes)?;
        let next = state.after(&step);
        let is_blurred =
            next.blur.symmetric_eigenvalues().min().sqrt() > MIN_BLUR * view.grid.step as f64;
        let moved = |(a, b): (&ViewPixel, &ViewPixel)| (a.0 - b.0).norm();
        let before = state.corners();
        let most = next.corners().iter().zip(&before).map(moved).fold(0.0, f64::max);
        // A print darker than its border is invalid.
        let is_print = next.white > next.black;
        if !is_blurred || !is_print || !most.is_finite() {
            return None;
        }
        state = next;
        if most < CONVERGED * view.grid.step as f64 {
            break;
        }
    }
    Some((state, noise))
}

/// The corners at the end, with their covariance.
fn result(
    view: &PrintView<'_>,
    (state, noise): (State, f64),
    sums: &RobustSums,
    grain: Grain,
) -> Option<RefinedCorners> {
    let correlation = sums.products.map(|product| product / sums.squares.max(1e-12));
    let inverse = sums.normal().cholesky()?.inverse();
    let covariance =
        inverse * sums.scattered()? * inverse * grain.variance_factor(view.grid.step, correlation);
    let place: SMatrix<f64, PLACE, PLACE> =
        covariance.fixed_view::<PLACE, PLACE>(0, 0).into_owned();
    let sigmas_px = CORNERS.map(|at| {
        let jacobian = state.jacobian(at);
        let rows = [0, 1].map(|k| {
            let row = SVector::from(by_place(jacobian.row(k).transpose(), at));
            (place * row).dot(&row)
        });
        ((rows[0] + rows[1]) / 2.0).sqrt()
    });
    let is_finite = sigmas_px.iter().all(|sigma_px| sigma_px.is_finite());
    let jacobian = state.jacobian((0.0, 0.0));
    // The first side runs along the square's x axis.
    let across = [jacobian.column(0), jacobian.column(1)].map(|along| {
        let normal = Vector2::new(-along.y, along.x).normalize();
        (state.blur * normal).dot(&normal).sqrt()
    });
    let crowding = (0..2).map(|k| {
        let cell = view.pixels_per_side(&state)[k] / view.cells as f64;
        CROWDING * across[k] * (across[k] / cell).powi(2)
    });
    let crowding = crowding.fold(0.0, f64::max);
    is_finite.then(|| RefinedCorners {
        corners_in_view: state.corners(),
        sigmas_px: sigmas_px.map(|sigma_px| sigma_px.hypot(crowding)),
        blur_px: across,
        white: state.white,
        black: state.black,
        residual_sigma: noise / (state.white - state.black),
    })
}

/// The surroundings beyond the quiet zone are modelled coarsely. They shift corners by this share
/// of the blur where a cell is as wide as the blur. For wider cells the shift falls with the square
/// of the ratio. Measured on rendered markers (`tests/corners.rs`).
const CROWDING: f64 = 0.04;

/// Additional width of the quiet zone, because prints are cut generously.
const QUIET_MARGIN_CELLS: f64 = 0.25;

/// The grid of pixels within `reach` sides of the square and inside the image.
fn grid(image: &LumaImage<'_>, state: &State, reach: f64, step: usize) -> Option<Grid> {
    let out = 1.0 + 2.0 * reach;
    let corners = CORNERS
        .map(|(p, q)| cartesian(state.view_from_square * Vector3::new(p * out, q * out, 1.0)));
    let span = |k: usize, size: usize| -> Option<(usize, usize)> {
        let values = corners.map(|corner| corner[k]);
        let least = values.iter().copied().fold(f64::INFINITY, f64::min).floor().max(0.0);
        let most = values.iter().copied().fold(0.0, f64::max).ceil().min(size as f64 - 1.0);
        // False for a NaN.
        (most > least).then(|| (least as usize, (most - least) as usize / step + 1))
    };
    let (left, columns) = span(0, image.width())?;
    let (top, rows) = span(1, image.height())?;
    Some(Grid { left, top, columns, rows, step })
}

impl PrintView<'_> {
    /// Sums over the pixels at a state. With `scatter`, also the products that the covariance
    /// needs. `None` where too few pixels are left.
    fn sum(
        &self,
        state: &State,
        noise: f64,
        drawing: &mut Drawing,
        scatter: bool,
    ) -> Option<RobustSums> {
        let square_from_view = state.view_from_square.try_inverse()?;
        let count = self.cells as f64;
        let half = count / 2.0;
        let cells_from_square = Matrix3::new(count, 0.0, half, 0.0, count, half, 0.0, 0.0, 1.0);
        let cells_from_view = cells_from_square * square_from_view;
        let Grid { columns, rows, .. } = self.grid;
        drawing.draw(&self.grid, &cells_from_view, &state.blur)?;
        let contrast = state.white - state.black;
        let spread = (state.blur.trace() / 2.0).sqrt();
        // Distances of opposite sides in the view, pixels.
        let scale = self.pixels_per_side(state);
        let mut sums = RobustSums::new(columns * rows, scatter);
        let limit = 0.5 + self.reach;
        let mut above = vec![0.0; columns];
        for row in 0..rows {
            let mut left = 0.0;
            let luma = self.image.row(self.grid.at(0, row).1);
            for (column, above) in above.iter_mut().enumerate() {
                let (x, y) = self.grid.at(column, row);
                let at = square_from_view * Vector3::new(x as f64, y as f64, 1.0);
                let (p, q) = (at.x / at.z, at.y / at.z);
                let neighbours = [std::mem::take(&mut left), std::mem::take(above)];
                // In this form a NaN counts as outside.
                if !(p.abs() < limit && q.abs() < limit) {
                    continue;
                }
                let k = row * columns + column;
                if self.hidden.get(k).copied().unwrap_or_default() {
                    continue;
                }
                let white = f64::from(drawing.white[k]);
                let mut values = [0.0; ROOM];
                let mut last = BEYOND;
                let mut model = state.black + contrast * white;
                for (side, outside) in [-q, p, q, -p].into_iter().enumerate() {
                    let depth = (outside - 0.5 - self.quiet) * scale[side % 2] / spread;
                    if depth > -3.5 {
                        let share = density_and_distribution(depth).1;
                        values[BEYOND + side] = share;
                        last = UNKNOWNS;
                        model += state.beyond[side] * share;
                    }
                }
                let residual = f64::from(self.light.of(luma[x])) - model;
                if luma[x] >= CLIPPED_CODE && residual < 0.0 {
                    continue;
                }
                let gradient = Vector2::new(drawing.by_x[k].into(), drawing.by_y[k].into());
                let jacobian = state.jacobian((p, q));
                // Moving the print to the right darkens a pixel where white increases to the right.
                let place = by_place(jacobian.transpose() * gradient * -contrast, (p, q));
                values[..PLACE].copy_from_slice(&place);
                let by_blur = self.by_blur(drawing, column, row, contrast);
                values[BLUR..WHITE].copy_from_slice(&by_blur);
                values[WHITE] = white;
                values[BLACK] = 1.0 - white;
                let weighted = sums.add(k, &values, last, residual, noise);
                sums.squares += weighted * weighted;
                for (product, neighbour) in sums.products.iter_mut().zip(neighbours) {
                    *product += weighted * neighbour;
                }
                (left, *above) = (weighted, weighted);
            }
        }
        if sums.sizes.len() < 3 * UNKNOWNS {
            return None;
        }
        self.add_priors(&mut sums, state, noise);
        Some(sums)
    }

    /// Derivatives of a grid point's radiance by the three unknowns of the blur.
    #[inline(always)]
    fn by_blur(&self, drawing: &Drawing, column: usize, row: usize, contrast: f64) -> [f64; 3] {
        let Grid { columns, rows, step, .. } = self.grid;
        let k = row * columns + column;
        // The heat equation: adding to a Gaussian's covariance adds half the curvature.
        let over = contrast / (4.0 * step as f64);
        let across = (k - usize::from(column > 0), k + usize::from(column + 1 < columns));
        let down =
            (if row > 0 { k - columns } else { k }, if row + 1 < rows { k + columns } else { k });
        let slope =
            |plane: &[f32], (from, to): (usize, usize)| f64::from(plane[to] - plane[from]) * over;
        [slope(&drawing.by_x, across), 2.0 * slope(&drawing.by_x, down), slope(&drawing.by_y, down)]
    }

    /// Adds priors of a pixel's weight. They matter only where pixels determine nothing.
    fn add_priors(&self, sums: &mut RobustSums, state: &State, noise: f64) {
        let spread = (state.blur.trace() / 2.0).sqrt();
        let mut hold = |index: usize, sigma: f64, residual: f64| {
            sums.hold(index, (noise / sigma).powi(2), residual);
        };
        for index in 0..PLACE {
            hold(index, 0.5, 0.0);
        }
        for index in BLUR..WHITE {
            hold(index, spread * spread, 0.0);
        }
        hold(WHITE, self.contrast, 0.0);
        hold(BLACK, self.contrast, 0.0);
        for side in 0..4 {
            hold(BEYOND + side, 0.5 * self.contrast, -state.beyond[side]);
        }
    }

    /// Whether an object, including its soft edge, hides the print at each pixel of the grid. Empty
    /// if none does, or if so much would be hidden that the state must be wrong.
    fn hidden(&self, sums: &RobustSums, (state, noise): (State, f64)) -> Vec<bool> {
        let least = least_residual(noise, state.white);
        let blur = (state.blur.trace() / 2.0).sqrt() / self.grid.step as f64;
        let reach = reach_px(blur) as usize;
        let Grid { columns, rows, .. } = self.grid;
        let mut hidden = vec![false; columns * rows];
        for (size, place) in sums.sizes.iter().zip(&sums.places) {
            if *size > least {
                let at = ((place % columns) as isize, (place / columns) as isize);
                mark_disc(&mut hidden, columns, at, reach);
            }
        }
        let share = sums.places.iter().filter(|place| hidden[**place]).count() as f64
            / sums.places.len() as f64;
        if share > 0.0 && share < MAX_HIDDEN_SHARE { hidden } else { Vec::new() }
    }

    /// Distance of the first side from the third, then of the second from the fourth, pixels.
    fn pixels_per_side(&self, state: &State) -> [f64; 2] {
        let jacobian = state.jacobian((0.0, 0.0));
        let (across, down) = (jacobian.column(0), jacobian.column(1));
        let area = across.perp(&down).abs();
        [area / across.norm(), area / down.norm()]
    }
}
