//! The local half of the covering method: moves directions until the deepest hole between them is
//! as shallow as it gets.
//!
//! The holes are the facets of the convex hull. With c_f the cosine of facet f's circumradius, the
//! ascent maximises the smallest c_f. This is Huard's method of centres: for a level t below all
//! c_f the sum of 1/(c_f - t) is made smaller by Newton's method, and t follows the smallest c_f
//! ever closer. Only sums, products and square roots are taken, which every machine rounds alike.

use nalgebra::{Matrix3, Vector3};

use super::hull::{Triangle, covering_cosine, hull};

/// Factor by which the gap between the level and the deepest hole shrinks in each step.
const SHRINK: f64 = 0.8;

/// Directions on their way to a covering.
#[derive(Debug, Clone)]
pub(super) struct Ascent {
    pub(super) points: Vec<Vector3<f64>>,
    facets: Vec<Triangle>,
    damping: f64,
}

impl Ascent {
    /// Starts at `points`; `None` where they have no hull.
    pub(super) fn new(points: Vec<Vector3<f64>>) -> Option<Self> {
        let facets = hull(&points)?;
        Some(Self { points, facets, damping: 1e-3 })
    }

    /// Cosine of the present covering radius.
    pub(super) fn cosine(&self) -> f64 {
        covering_cosine(&self.facets)
    }

    /// Moves each direction to the mean of the holes around it, weighted by their depth. It is no
    /// ascent, but leads from any start to even directions.
    pub(super) fn relax(&mut self, rounds: usize) {
        for _ in 0..rounds {
            let mut sums = vec![Vector3::zeros(); self.points.len()];
            for facet in &self.facets {
                for corner in facet.corners {
                    sums[corner] += facet.normal * (1.0 - facet.cosine);
                }
            }
            let moved: Vec<_> = sums.iter().map(|sum| sum / sum.norm_squared().sqrt()).collect();
            let Some(facets) = hull(&moved) else { return };
            self.points = moved;
            self.facets = facets;
        }
    }

    /// Ascends with the level `first_gap` below the deepest hole's cosine at first, `last_gap` at
    /// last.
    pub(super) fn go_on(&mut self, first_gap: f64, last_gap: f64) {
        let mut gap = first_gap;
        while gap > last_gap {
            self.step(gap);
            gap *= SHRINK;
        }
    }

    /// One damped Newton step for the level `gap` below the deepest hole's cosine. If no step
    /// helps, nothing changes.
    fn step(&mut self, gap: f64) {
        let level = self.cosine() - gap;
        let frames: Vec<_> = self.points.iter().map(tangents).collect();
        let (slope, curvature) = self.derivatives(level, &frames);
        let before = potential(&self.facets, level);
        for _ in 0..12 {
            let damping = self.damping * mean_diagonal(&curvature, slope.len());
            if let Some(step) = solve(&curvature, &slope, damping) {
                let moved: Vec<_> = self
                    .points
                    .iter()
                    .enumerate()
                    .map(|(index, point)| {
                        let [u, v] = frames[index];
                        let moved = point - u * step[2 * index] - v * step[2 * index + 1];
                        moved / moved.norm_squared().sqrt()
                    })
                    .collect();
                if let Some(facets) = hull(&moved)
                    && covering_cosine(&facets) > level
                    && potential(&facets, level) < before
                {
                    self.points = moved;
                    self.facets = facets;
                    self.damping = (self.damping / 8.0).max(1e-12);
                    return;
                }
            }
            self.damping = (self.damping * 8.0).min(1e3);
        }
    }

    /// Gradient and Hessian (row by row) of the potential in the directions' tangent planes.
    ///
    /// With p_i the corners, n the normal and w_i the barycentric coordinates of the plane's point
    /// nearest to the sphere's middle, dc/dp_i = w_i n. With h_i the gradient of the i-th
    /// barycentric coordinate, d2c/dp_i dp_j = -c (h_i.h_j) n n' - w_j n h_i' - w_i h_j n'; the
    /// sphere's own curvature takes w_i c from the diagonal.
    fn derivatives(&self, level: f64, frames: &[[Vector3<f64>; 2]]) -> (Vec<f64>, Vec<f64>) {
        let size = 2 * self.points.len();
        let mut slope = vec![0.0; size];
        let mut curvature = vec![0.0; size * size];
        for facet in &self.facets {
            let (normal, cosine) = (facet.normal, facet.cosine);
            let corner = facet.corners.map(|index| self.points[index]);
            let twice_area = (corner[1] - corner[0]).cross(&(corner[2] - corner[0])).dot(&normal);
            let rise: [_; 3] = std::array::from_fn(|i| {
                normal.cross(&(corner[(i + 2) % 3] - corner[(i + 1) % 3])) / twice_area
            });
            let weight: [_; 3] = std::array::from_fn(|i| -rise[i].dot(&corner[(i + 1) % 3]));
            let above = cosine - level;
            let (first, second) = (-1.0 / (above * above), 2.0 / (above * above * above));
            let gradient: [[f64; 2]; 3] = std::array::from_fn(|i| {
                frames[facet.corners[i]].map(|tangent| weight[i] * normal.dot(&tangent))
            });
            for i in 0..3 {
                let at = 2 * facet.corners[i];
                for (axis, value) in gradient[i].iter().enumerate() {
                    slope[at + axis] += first * value;
                }
                for j in 0..3 {
                    let block: Matrix3<f64> =
                        -cosine * rise[i].dot(&rise[j]) * normal * normal.transpose()
                            - weight[j] * normal * rise[i].transpose()
                            - weight[i] * rise[j] * normal.transpose();
                    for (a, u) in frames[facet.corners[i]].iter().enumerate() {
                        for (b, v) in frames[facet.corners[j]].iter().enumerate() {
                            let mut bend = u.dot(&(block * v));
                            if i == j && a == b {
                                bend -= weight[i] * cosine;
                            }
                            let product = gradient[i][a] * gradient[j][b];
                            curvature[(at + a) * size + 2 * facet.corners[j] + b] +=
                                second * product + first * bend;
                        }
                    }
                }
            }
        }
        (slope, curvature)
    }
}

/// Sum over the holes of 1/(c_f - level).
fn potential(facets: &[Triangle], level: f64) -> f64 {
    facets.iter().map(|facet| 1.0 / (facet.cosine - level)).sum()
}

/// Two unit vectors across `point` and each other.
fn tangents(point: &Vector3<f64>) -> [Vector3<f64>; 2] {
    let helper = if point.x.abs() < 0.6 { Vector3::x() } else { Vector3::y() };
    let across = point.cross(&helper);
    let u = across / across.norm_squared().sqrt();
    [u, point.cross(&u)]
}

/// The mean size of a square matrix's diagonal.
fn mean_diagonal(matrix: &[f64], size: usize) -> f64 {
    let diagonal = (0..size).map(|k| matrix[k * (size + 1)].abs());
    diagonal.sum::<f64>() / size as f64
}

/// Solves (matrix + damping) x = right for a symmetric matrix by Cholesky's decomposition; `None`
/// where that is not positive definite. Written out, because libraries choose their instructions,
/// and with them their rounding, by the processor.
fn solve(matrix: &[f64], right: &[f64], damping: f64) -> Option<Vec<f64>> {
    let n = right.len();
    let mut upper = matrix.to_vec();
    let mut x = right.to_vec();
    for k in 0..n {
        let pivot = upper[k * n + k] + damping;
        if pivot.is_nan() || pivot <= 1e-14 * damping {
            return None;
        }
        let (above, below) = upper.split_at_mut((k + 1) * n);
        let row = &above[k * n..];
        // Row i loses row k times l_ik; only the upper triangle is kept.
        for i in k + 1..n {
            let factor = row[i] / pivot;
            if factor != 0.0 {
                let target = &mut below[(i - k - 1) * n + i..(i - k) * n];
                for (value, from) in target.iter_mut().zip(&row[i..]) {
                    *value -= factor * from;
                }
                x[i] -= factor * x[k];
            }
        }
    }
    for k in (0..n).rev() {
        let row = &upper[k * n..(k + 1) * n];
        let known: f64 = row[k + 1..].iter().zip(&x[k + 1..]).map(|(a, b)| a * b).sum();
        x[k] = (x[k] - known) / (row[k] + damping);
    }
    Some(x)
}
