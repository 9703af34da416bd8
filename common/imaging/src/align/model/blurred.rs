//! A printed facet blurred by a Gaussian, in closed form.
//!
//! A point spread of covariance S in the image has covariance Q S Q' in the facet's plane, with Q
//! the derivative of the plane's coordinates by the pixel. If that covariance is diagonal, a
//! blurred cell is a product of differences of the Gaussian's distribution function F. On a facet
//! seen at an angle it is not diagonal. Then it is split: with correlation r and standard
//! deviations (a, b),
//!
//! ```text
//! [a^2, r a b; r a b, b^2] = (1 - |r|) diag(a^2, b^2) + |r| d d',   d = (a, sign(r) b)
//! ```
//!
//! and the blur along the direction d is summed over one, two or three Gauss-Hermite nodes,
//! depending on r. The edges of the outline are straight, so each is F(distance / standard
//! deviation across the edge) for any covariance. Where two edges meet, their product is taken.
//!
//! A body that moves during the exposure is also blurred evenly along its path. A path as long as
//! two cells cancels them, and a longer one turns black into white. So the model is the mean over
//! parts of the path ([`middles`]).

use nalgebra::{Matrix2, Vector2};

use crate::align::print::{Cells, MAX_CELLS, PrintedFacet};
use crate::align::spread::middles;
use crate::gaussian::{Gaussian, REACH};

/// A blurred indicator function at a point of the plane, with its derivatives by the coordinates in
/// metres. The second derivatives are xx, xy, yy.
///
/// `by_path` is its derivative by the path, metres, where the parts' Gaussians do not change.
#[derive(Debug, Clone, Copy, Default)]
pub(in crate::align) struct Share {
    pub value: f32,
    pub slope: [f32; 2],
    pub curvature: [f32; 3],
    pub by_path: [f32; 2],
}

impl Share {
    /// Adds another one, at a share of the path.
    #[inline(always)]
    fn add(&mut self, weight: f32, path_share: f32, other: &Self) {
        self.value += weight * other.value;
        for (sum, part) in self.slope.iter_mut().zip(other.slope) {
            *sum += weight * part;
        }
        for (sum, part) in self.curvature.iter_mut().zip(other.curvature) {
            *sum += weight * part;
        }
        for (sum, part) in self.by_path.iter_mut().zip(other.slope) {
            *sum += weight * path_share * part;
        }
    }
}

/// One facet with one point spread.
#[derive(Clone)]
pub(in crate::align) struct BlurredFacet<'p> {
    cells: Option<BlurredCells<'p>>,
    edges: Vec<OutlineEdge>,
    /// Number of parts of the body's path during the exposure; 1 without a path.
    parts: u8,
    gaussian: Gaussian,
}

#[derive(Clone)]
struct BlurredCells<'p> {
    cells: &'p Cells,
    /// Standard deviations along x and y, cells.
    sigma: [f32; 2],
    /// Weight and position of each Gauss-Hermite node, cells, and its share of the path.
    nodes: Vec<(f32, [f32; 2], f32)>,
}

#[derive(Clone)]
struct OutlineEdge {
    /// Depth inside the edge is `normal . at + offset`, standard deviations of the whole blur.
    normal: Vector2<f32>,
    offset: f32,
    /// Standard deviation of the whole blur, relative to the Gaussian alone.
    steepness: f32,
    /// Additional depth after the whole path, standard deviations of the Gaussian.
    shift: f32,
}

impl OutlineEdge {
    /// Depth of a point at a share of the path from its middle, standard deviations of the
    /// Gaussian.
    #[inline(always)]
    fn depth_at(&self, at: &Vector2<f32>, share: f32) -> f32 {
        (self.normal.dot(at) + self.offset) * self.steepness + share * self.shift
    }
}

/// Weights of the cells within reach of the Gaussian, along one axis.
///
/// A cell's weight is the difference of F at its two borders.
struct CellWeights {
    /// The first cell within reach.
    first: usize,
    count: usize,
    /// Weight, with its first and second derivative by the coordinate.
    cells: [[f32; 3]; MAX_CELLS],
}

impl CellWeights {
    const NONE: Self = Self { first: 0, count: 0, cells: [[0.0; 3]; MAX_CELLS] };
}

impl<'p> BlurredFacet<'p> {
    /// Creates the blurred facet. `covariance` is that of each part's Gaussian in the facet's plane,
    /// metres squared. `path` is the body's motion there during the exposure, metres, in this many
    /// `parts`.
    pub(crate) fn new(
        facet: &'p PrintedFacet,
        covariance: &Matrix2<f64>,
        path: &Vector2<f64>,
        parts: u8,
    ) -> Self {
        let cells =
            facet.cells.as_ref().map(|cells| BlurredCells::new(cells, covariance, path, parts));
        let middle = facet.middle();
        let count = facet.outline.len();
        // Standard deviation of the parts' middles, as a share of the path.
        let middles_deviation = ((1.0 - f64::from(parts).powi(-2)) / 12.0).sqrt();
        let edges = (0..count)
            .map(|k| {
                let (from, to) = (facet.outline[k], facet.outline[(k + 1) % count]);
                let along = (to - from).normalize();
                let across = Vector2::new(-along.y, along.x);
                let inwards = if across.dot(&(middle - from)) < 0.0 { -across } else { across };
                let of_gaussian = inwards.dot(&(covariance * inwards)).sqrt();
                let shift = inwards.dot(path);
                let sigma = of_gaussian.hypot(shift * middles_deviation);
                OutlineEdge {
                    normal: (inwards / sigma).cast(),
                    offset: (-inwards.dot(&from.coords) / sigma) as f32,
                    steepness: (sigma / of_gaussian) as f32,
                    shift: (shift / of_gaussian) as f32,
                }
            })
            .collect();
        Self { cells, edges, parts, gaussian: Gaussian::get() }
    }

    /// Depth of a point inside edge `k`, standard deviations of the point spread.
    #[inline]
    pub(crate) fn depth(&self, k: usize, at: Vector2<f64>) -> f32 {
        let at: Vector2<f32> = at.cast();
        self.edges[k].normal.dot(&at) + self.edges[k].offset
    }

    /// Derivative of that depth by the plane's coordinates, per metre.
    pub(crate) fn inwards(&self, k: usize) -> Vector2<f32> {
        self.edges[k].normal
    }

    /// Radiance at a point of a blurred line along edge `k`, of one unit of radiance times metres.
    #[inline(always)]
    pub(crate) fn line(&self, k: usize, at: Vector2<f64>) -> f64 {
        let (edge, at) = (&self.edges[k], at.cast());
        let densities =
            middles(self.parts).map(|share| self.gaussian.at(edge.depth_at(&at, share)).0);
        let density = densities.sum::<f32>() / f32::from(self.parts);
        f64::from(density * edge.steepness * edge.normal.norm())
    }

    /// The facet's blurred coverage.
    #[inline(always)]
    pub(crate) fn coverage(&self, at: Vector2<f64>) -> Share {
        let at: Vector2<f32> = at.cast();
        if self.parts == 1 {
            return self.coverage_at(&at, 0.0);
        }
        let is_inside =
            |edge: &OutlineEdge| edge.depth_at(&at, 0.0) >= REACH + edge.shift.abs() / 2.0;
        if self.edges.iter().all(is_inside) {
            return Share { value: 1.0, ..Share::default() };
        }
        let (mut mean, weight) = (Share::default(), 1.0 / f32::from(self.parts));
        for share in middles(self.parts) {
            mean.add(weight, share, &self.coverage_at(&at, share));
        }
        mean
    }

    /// The coverage by the part whose middle is at this share of the path.
    #[inline(always)]
    fn coverage_at(&self, at: &Vector2<f32>, path_share: f32) -> Share {
        let mut share = Share { value: 1.0, ..Share::default() };
        for edge in &self.edges {
            let z = edge.depth_at(at, path_share);
            if z >= REACH {
                continue;
            }
            let (density, below) = self.gaussian.at(z);
            let (normal, bend) = (edge.normal * edge.steepness, -z * density);
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
                ..share
            };
        }
        share
    }

    /// The blurred share of black; zero on a facet without a marker.
    #[inline(always)]
    pub(crate) fn black(&self, at: Vector2<f64>) -> Share {
        let Some(blurred) = &self.cells else { return Share::default() };
        let mut sum = Share::default();
        let per_cell = 1.0 / blurred.cells.side_m as f32;
        let [x, y] = blurred.in_cells(at);
        let (mut across, mut down) = (CellWeights::NONE, CellWeights::NONE);
        for &(weight, [dx, dy], path_share) in &blurred.nodes {
            let count = blurred.cells.count;
            self.weigh(&mut across, x + dx, blurred.sigma[0], count);
            self.weigh(&mut down, y + dy, blurred.sigma[1], count);
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
            node.slope = node.slope.map(|slope| slope * per_cell);
            node.curvature = node.curvature.map(|curvature| curvature * per_cell * per_cell);
            sum.add(weight, path_share, &node);
        }
        sum
    }

    /// The marker's whole square, as if all its cells were black, and the square inside its border,
    /// both blurred; zero on a facet without a marker.
    pub(crate) fn squares(&self, at: Vector2<f64>) -> [f32; 2] {
        let mut sums = [0.0; 2];
        let Some(blurred) = &self.cells else { return sums };
        let count = blurred.cells.count;
        let [x, y] = blurred.in_cells(at);
        for &(weight, [dx, dy], _) in &blurred.nodes {
            let between = |at: f32, sigma: f32, from: usize, to: usize| {
                let below = |border: usize| self.gaussian.at((at - border as f32) / sigma).1;
                below(from) - below(to)
            };
            for (sum, (from, to)) in sums.iter_mut().zip([(0, count), (1, count - 1)]) {
                *sum += weight
                    * (between(x + dx, blurred.sigma[0], from, to)
                        * between(y + dy, blurred.sigma[1], from, to));
            }
        }
        sums
    }

    /// Computes the weights of cells along an axis for a point, in cells from the square's edge.
    ///
    /// They are written in place, because a move would take longer than the computation.
    #[inline(always)]
    fn weigh(&self, weights: &mut CellWeights, at: f32, sigma: f32, count: usize) {
        weights.count = 0;
        let (per_sigma, reach) = (1.0 / sigma, REACH * sigma);
        let (from, to) = (at - reach, at + reach);
        // At most MAX_CELLS. See `Gaussian::at` for the type.
        let count = count as u16;
        // No border from 0 to `count` is within reach; a NaN reaches none.
        if !(to >= 0.0 && from <= f32::from(count)) {
            return;
        }
        // The casts truncate and saturate.
        let low = if from <= 0.0 { 0 } else { from as u16 + 1 };
        let high = (to as u16).min(count);
        // From the cell before the first border in reach to that after the last. Below, F is 1.
        weights.first = usize::from(low.saturating_sub(1));
        let mut before = [1.0, 0.0, 0.0];
        let mut place = 0;
        for border in low..=high {
            let z = (at - f32::from(border)) * per_sigma;
            let (density, below) = self.gaussian.at(z);
            let slope = density * per_sigma;
            let here = [below, slope, -z * slope * per_sigma];
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

/// A point spread whose standard deviation is below this many cells is narrow.
const NARROW_BLUR_CELLS: f64 = 0.3;

impl<'p> BlurredCells<'p> {
    fn new(cells: &'p Cells, covariance: &Matrix2<f64>, path: &Vector2<f64>, parts: u8) -> Self {
        let (a, b) = (covariance[(0, 0)].sqrt(), covariance[(1, 1)].sqrt());
        let correlation = (covariance[(0, 1)] / (a * b)).clamp(-0.98, 0.98);
        let along = Vector2::new(a, b * correlation.signum()) / cells.side_m;
        // Nodes are (weight, position along d in standard deviations). Straight edges are exact
        // with any number of nodes; more nodes matter at the corners of cells. On cells much wider
        // than the blur few pixels lie near a corner.
        let tolerance = if a.max(b) < NARROW_BLUR_CELLS * cells.side_m { 0.25 } else { 0.1 };
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
                (weight as f32, [at.x as f32, at.y as f32], 0.0)
            })
            .collect::<Vec<_>>();
        let path = (path / cells.side_m).cast::<f32>();
        let in_part = |&(weight, [x, y], _): &(f32, [f32; 2], f32)| {
            let weight = weight / f32::from(parts);
            middles(parts)
                .map(move |share| (weight, [x + share * path.x, y + share * path.y], share))
        };
        let nodes = nodes.iter().flat_map(in_part).collect();
        Self { cells, sigma: [(a * own) as f32, (b * own) as f32], nodes }
    }

    /// A point of the plane, in cells from the square's top left corner.
    #[inline]
    fn in_cells(&self, at: Vector2<f64>) -> [f32; 2] {
        let half = self.cells.count as f32 / 2.0;
        let per_cell = 1.0 / self.cells.side_m;
        [(at.x * per_cell) as f32 + half, (at.y * per_cell) as f32 + half]
    }
}
