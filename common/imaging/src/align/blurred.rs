//! A printed facet seen through a Gaussian, in closed form.
//!
//! The point spread, a Gaussian of covariance S in the image, is one of covariance Q S Q' in the
//! facet's plane, Q being the plane's coordinates by pixels. Axis-parallel cells blurred along the
//! axes are products of differences of the Gaussian's distribution function F. A covariance that is
//! no diagonal, as on a facet seen aslant, is split: with correlation r and deviations (a, b),
//!
//! ```text
//! [a^2, r a b; r a b, b^2] = (1 - |r|) diag(a^2, b^2) + |r| d d',   d = (a, sign(r) b)
//! ```
//!
//! and the blur along the single direction d is summed by Gauss-Hermite nodes, one, two or three as
//! r asks for. Edges of the facet's outline are straight, so each is F of the distance over the
//! deviation across it, whatever the covariance; where two meet, their product.

use nalgebra::{Matrix2, Vector2};

use super::print::{Cells, MAX_CELLS, PrintedFacet};
use crate::gaussian::{Gaussian, REACH};

/// A blurred indicator at a point of the plane: value, slope and curvature by the coordinates
/// (metres; the curvature's entries are xx, xy, yy).
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Share {
    pub value: f32,
    pub slope: [f32; 2],
    pub curvature: [f32; 3],
}

/// Parts of a marker, blurred: what acceptance compares the image with.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Parts {
    /// All black cells.
    pub black: f32,
    /// The whole black square, as if all its cells were black.
    pub square: f32,
    /// The square within the border.
    pub inside: f32,
}

/// One facet with one point spread.
#[derive(Clone)]
pub(super) struct BlurredFacet<'p> {
    cells: Option<BlurredCells<'p>>,
    edges: Vec<Edge>,
    gaussian: Gaussian,
}

#[derive(Clone)]
struct BlurredCells<'p> {
    cells: &'p Cells,
    /// Deviations along x and y, cells.
    deviation: [f32; 2],
    /// Weights of the nodes, and where they lie, cells.
    nodes: Vec<(f32, [f32; 2])>,
}

#[derive(Clone)]
struct Edge {
    /// Distance inwards is `normal . at + offset`, in deviations across the edge.
    normal: Vector2<f32>,
    offset: f32,
}

/// The cells that a Gaussian reaches, from the first on: for each its weight, a difference of F at
/// its borders, and the weight's first and second derivative by the coordinate.
struct Weights {
    first: usize,
    count: usize,
    /// Value, slope and curvature.
    cells: [[f32; 3]; MAX_CELLS],
}

impl Weights {
    const NONE: Self = Self { first: 0, count: 0, cells: [[0.0; 3]; MAX_CELLS] };
}

impl<'p> BlurredFacet<'p> {
    /// `covariance`: of the point spread in the facet's plane, metres squared.
    pub fn new(facet: &'p PrintedFacet, covariance: &Matrix2<f64>) -> Self {
        let cells = facet.cells.as_ref().map(|cells| BlurredCells::new(cells, covariance));
        let middle = facet.middle();
        let count = facet.outline.len();
        let edges = (0..count)
            .map(|k| {
                let (from, to) = (facet.outline[k], facet.outline[(k + 1) % count]);
                let along = (to - from).normalize();
                let across = Vector2::new(-along.y, along.x);
                let inwards = if across.dot(&(middle - from)) < 0.0 { -across } else { across };
                let deviation = inwards.dot(&(covariance * inwards)).sqrt();
                Edge {
                    normal: (inwards / deviation).cast(),
                    offset: (-inwards.dot(&from.coords) / deviation) as f32,
                }
            })
            .collect();
        Self { cells, edges, gaussian: Gaussian::get() }
    }

    /// How far inside of edge `k` a point lies, in deviations of the point spread.
    #[inline]
    pub fn depth(&self, k: usize, at: Vector2<f64>) -> f32 {
        let at: Vector2<f32> = at.cast();
        self.edges[k].normal.dot(&at) + self.edges[k].offset
    }

    /// How that depth grows, by the plane's metres.
    pub fn inwards(&self, k: usize) -> Vector2<f32> {
        self.edges[k].normal
    }

    /// A line of no width along edge `k`, blurred: its light for each unit of light times metres.
    #[inline(always)]
    pub fn line(&self, k: usize, at: Vector2<f64>) -> f64 {
        let edge = &self.edges[k];
        let (density, _) = self.gaussian.at(self.depth(k, at));
        f64::from(density * edge.normal.norm())
    }

    /// The facet's coverage.
    #[inline(always)]
    pub fn coverage(&self, at: Vector2<f64>) -> Share {
        let at: Vector2<f32> = at.cast();
        let mut share = Share { value: 1.0, ..Share::default() };
        for edge in &self.edges {
            let z = edge.normal.dot(&at) + edge.offset;
            if z >= REACH {
                continue;
            }
            let (density, below) = self.gaussian.at(z);
            let (normal, bend) = (edge.normal, -z * density);
            let (value, [sx, sy], [xx, xy, yy]) = (share.value, share.slope, share.curvature);
            share = Share {
                value: value * below,
                slope: [
                    sx * below + value * density * normal.x,
                    sy * below + value * density * normal.y,
                ],
                curvature: [
                    xx * below + 2.0 * sx * density * normal.x + value * bend * normal.x * normal.x,
                    xy * below
                        + (sx * normal.y + sy * normal.x) * density
                        + value * bend * normal.x * normal.y,
                    yy * below + 2.0 * sy * density * normal.y + value * bend * normal.y * normal.y,
                ],
            };
        }
        share
    }

    /// The share of black; nothing on a facet without marker.
    #[inline(always)]
    pub fn black(&self, at: Vector2<f64>) -> Share {
        let Some(blurred) = &self.cells else { return Share::default() };
        let mut sum = Share::default();
        let per_cell = 1.0 / blurred.cells.side_m as f32;
        let [x, y] = blurred.in_cells(at);
        let (mut across, mut down) = (Weights::NONE, Weights::NONE);
        for &(weight, [dx, dy]) in &blurred.nodes {
            let count = blurred.cells.count;
            self.weigh(&mut across, x + dx, blurred.deviation[0], count);
            self.weigh(&mut down, y + dy, blurred.deviation[1], count);
            let mut node = Share::default();
            for (row, &[value, slope, curvature]) in down.cells[..down.count].iter().enumerate() {
                let start = (down.first + row) * count + across.first;
                let black = &blurred.cells.black[start..start + across.count];
                let mut sums = [0.0; 3];
                for (black, cell) in black.iter().zip(&across.cells) {
                    for (sum, part) in sums.iter_mut().zip(cell) {
                        *sum += black * part;
                    }
                }
                node.value += value * sums[0];
                node.slope[0] += value * sums[1];
                node.slope[1] += slope * sums[0];
                node.curvature[0] += value * sums[2];
                node.curvature[1] += slope * sums[1];
                node.curvature[2] += curvature * sums[0];
            }
            sum.value += weight * node.value;
            for k in 0..2 {
                sum.slope[k] += weight * per_cell * node.slope[k];
            }
            for k in 0..3 {
                sum.curvature[k] += weight * per_cell * per_cell * node.curvature[k];
            }
        }
        sum
    }

    /// The marker's parts; nothing on a facet without one.
    pub fn parts(&self, at: Vector2<f64>) -> Parts {
        let Some(blurred) = &self.cells else { return Parts::default() };
        let count = blurred.cells.count;
        let mut sum = Parts { black: self.black(at).value, ..Parts::default() };
        let [x, y] = blurred.in_cells(at);
        for &(weight, [dx, dy]) in &blurred.nodes {
            let between = |at: f32, deviation: f32, from: usize, to: usize| {
                let below = |border: usize| self.gaussian.at((at - border as f32) / deviation).1;
                below(from) - below(to)
            };
            let both = |from, to| {
                between(x + dx, blurred.deviation[0], from, to)
                    * between(y + dy, blurred.deviation[1], from, to)
            };
            sum.square += weight * both(0, count);
            sum.inside += weight * both(1, count - 1);
        }
        sum
    }

    /// Weights of the cells along one axis, seen at `at` (cells from the square's edge).
    ///
    /// They are written in place: moving them would take longer than finding them.
    #[inline(always)]
    fn weigh(&self, weights: &mut Weights, at: f32, deviation: f32, count: usize) {
        weights.count = 0;
        let (per_deviation, reach) = (1.0 / deviation, REACH * deviation);
        let (from, to) = (at - reach, at + reach);
        // At most MAX_CELLS; see `Gaussian::at` for the type.
        let count = count as u16;
        // Borders 0 to `count`, those in reach; written so that a NaN reaches none.
        if !(to >= 0.0 && from <= f32::from(count)) {
            return;
        }
        // Casts cut off what is behind the point, and saturate.
        let low = if from <= 0.0 { 0 } else { from as u16 + 1 };
        let high = (to as u16).min(count);
        // Cells from the one before the first such border to the one behind the last. Borders below
        // `low` lie far behind: F is 1 there, if there is a cell behind them.
        weights.first = usize::from(low.saturating_sub(1));
        let mut before = [1.0, 0.0, 0.0];
        let mut place = 0;
        for border in low..=high {
            let z = (at - f32::from(border)) * per_deviation;
            let (density, below) = self.gaussian.at(z);
            let slope = density * per_deviation;
            let here = [below, slope, -z * slope * per_deviation];
            if border > 0 {
                weights.cells[place] =
                    [before[0] - here[0], before[1] - here[1], before[2] - here[2]];
                place += 1;
            }
            before = here;
        }
        if high < count {
            weights.cells[place] = before;
            place += 1;
        }
        weights.count = place;
    }
}

/// Deviations of the point spread below so many cells are narrow.
const FINE_CELLS: f64 = 0.3;

impl<'p> BlurredCells<'p> {
    fn new(cells: &'p Cells, covariance: &Matrix2<f64>) -> Self {
        let (a, b) = (covariance[(0, 0)].sqrt(), covariance[(1, 1)].sqrt());
        let correlation = (covariance[(0, 1)] / (a * b)).clamp(-0.98, 0.98);
        let along = Vector2::new(a, b * correlation.signum()) / cells.side_m;
        // Where a node lies on the direction d, in its deviations.
        // Straight edges are right with any nodes; what they are for is where edges meet, which is
        // nowhere in particular on cells that are much wider than the blur.
        let tolerance = if a.max(b) < FINE_CELLS * cells.side_m { 0.25 } else { 0.1 };
        let (share, nodes): (f64, &[(f64, f64)]) = match correlation.abs() {
            r if r < tolerance => (0.0, &[(1.0, 0.0)]),
            r if r < 2.0 * tolerance => (r, &[(0.5, -1.0), (0.5, 1.0)]),
            r => (
                r,
                &[
                    (1.0 / 6.0, -1.732_050_807_568_877),
                    (2.0 / 3.0, 0.0),
                    (1.0 / 6.0, 1.732_050_807_568_877),
                ],
            ),
        };
        let own = (1.0 - share).sqrt() / cells.side_m;
        let nodes = nodes
            .iter()
            .map(|&(weight, place)| {
                let at = along * (share.sqrt() * place);
                (weight as f32, [at.x as f32, at.y as f32])
            })
            .collect();
        Self { cells, deviation: [(a * own) as f32, (b * own) as f32], nodes }
    }

    /// A point of the plane in cells from the square's top left.
    #[inline]
    fn in_cells(&self, at: Vector2<f64>) -> [f32; 2] {
        let half = self.cells.count as f32 / 2.0;
        let per_cell = 1.0 / self.cells.side_m;
        [(at.x * per_cell) as f32 + half, (at.y * per_cell) as f32 + half]
    }
}
