//! Sums over the pixels of a fit of the whole print, with Cauchy weights.

use nalgebra::{SMatrix, SVector};

/// Number of unknowns.
pub(super) const UNKNOWNS: usize = 17;
/// Scale of Cauchy's weight function, standard deviations.
const CAUCHY: f64 = 2.5;
/// Length of a row: the number of unknowns, rounded up to a multiple of four.
pub(super) const ROOM: usize = 20;

pub(super) type Normal = SMatrix<f64, UNKNOWNS, UNKNOWNS>;
pub(super) type Unknowns = SVector<f64, UNKNOWNS>;
/// Columns of the upper triangle of a symmetric matrix.
type Triangle = [[f64; ROOM]; UNKNOWNS];

/// Sums over the pixels at one state.
pub(super) struct RobustSums {
    /// Sum of the products of the rows, times the weights. If the scatter was requested, times the
    /// slopes of the influence function instead.
    normal: Triangle,
    /// Sum of the products of the rows, times the squares of the weighted residuals, if requested.
    scattered: Option<Triangle>,
    pub(super) gradient: Unknowns,
    /// Absolute residuals.
    pub(super) sizes: Vec<f64>,
    /// Places of the residuals in the grid.
    pub(super) places: Vec<usize>,
    /// Sum of the squares of the weighted residuals, and sums of their products with the one to the
    /// left and the one above.
    pub(super) squares: f64,
    pub(super) products: [f64; 2],
}

impl RobustSums {
    /// Empty sums with room for `pixels`; with `scatter` also sums that the covariance needs.
    pub(super) fn new(pixels: usize, scatter: bool) -> Self {
        let zeros = [[0.0; ROOM]; UNKNOWNS];
        Self {
            normal: zeros,
            scattered: scatter.then_some(zeros),
            gradient: Unknowns::zeros(),
            sizes: Vec::with_capacity(pixels),
            places: Vec::with_capacity(pixels),
            squares: 0.0,
            products: [0.0; 2],
        }
    }

    /// Adds the row of the pixel at `place` in the grid, of which only the first `last` values are
    /// not zero. Returns the weighted residual.
    pub(super) fn add(
        &mut self,
        place: usize,
        values: &[f64; ROOM],
        last: usize,
        residual: f64,
        noise: f64,
    ) -> f64 {
        let share = (residual / (CAUCHY * noise)).powi(2);
        let weight = 1.0 / (1.0 + share);
        self.sizes.push(residual.abs());
        self.places.push(place);
        let mut slope = weight;
        if let Some(scattered) = &mut self.scattered {
            add_product(scattered, values, last, (weight * residual).powi(2));
            // The slope of the influence function.
            slope = weight * weight * (1.0 - share);
        }
        add_product(&mut self.normal, values, last, slope);
        for (gradient, value) in self.gradient.iter_mut().zip(values) {
            *gradient += weight * residual * value;
        }
        weight * residual
    }

    /// Adds a prior of an unknown: `weight` times its square about `residual` from here.
    pub(super) fn hold(&mut self, unknown: usize, weight: f64, residual: f64) {
        self.normal[unknown][unknown] += weight;
        self.gradient[unknown] += weight * residual;
    }

    pub(super) fn normal(&self) -> Normal {
        symmetric(&self.normal)
    }

    /// Covariance of the gradient, from the residuals' squares, corrected for the degrees of
    /// freedom.
    pub(super) fn scattered(&self) -> Option<Normal> {
        let count = self.sizes.len() as f64;
        Some(symmetric(self.scattered.as_ref()?) * (count / (count - UNKNOWNS as f64)))
    }
}

/// Adds `factor` times the product of a row with itself.
fn add_product(triangle: &mut Triangle, values: &[f64; ROOM], last: usize, factor: f64) {
    for (k, column) in triangle.iter_mut().enumerate().take(last) {
        let scaled = factor * values[k];
        // In multiples of four, even beyond the diagonal.
        let end = (k | 3) + 1;
        for (sum, value) in column[..end].iter_mut().zip(&values[..end]) {
            *sum += scaled * value;
        }
    }
}

fn symmetric(triangle: &Triangle) -> Normal {
    Normal::from_fn(|row, column| triangle[row.max(column)][row.min(column)])
}
