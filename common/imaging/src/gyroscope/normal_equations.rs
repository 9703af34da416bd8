//! The normal equations of a step.

use nalgebra::{SMatrix, SVector};

/// Number of unknowns: three of the rotation, three of the translation, offset and gain.
pub(super) const UNKNOWNS: usize = 8;

pub(super) type Gradient = SVector<f64, UNKNOWNS>;
type Matrix8 = SMatrix<f64, UNKNOWNS, UNKNOWNS>;

/// Sums over points. Some are in single precision, because several fit into a register.
#[derive(Debug, Clone)]
pub(super) struct NormalEquations {
    normal: Matrix8,
    right: Gradient,
    partial_normal: [[f32; UNKNOWNS]; UNKNOWNS],
    partial_right: [f32; UNKNOWNS],
    added: usize,
}

/// Points that are summed in single precision.
const PARTIAL: usize = 256;

/// Priors: translation in distances of the scene, offset in code values, gain. They matter only
/// where there is hardly any texture.
const PRIOR_SIGMAS: [f64; UNKNOWNS] = [1.0, 1.0, 1.0, 0.3, 0.3, 0.3, 20.0, 0.3];

impl NormalEquations {
    pub(super) fn new() -> Self {
        let priors = Gradient::from_iterator(PRIOR_SIGMAS.iter().map(|sigma| sigma.powi(-2)));
        Self {
            normal: Matrix8::from_diagonal(&priors),
            right: Gradient::zeros(),
            partial_normal: [[0.0; UNKNOWNS]; UNKNOWNS],
            partial_right: [0.0; UNKNOWNS],
            added: 0,
        }
    }

    /// Adds a point's row, weighted.
    #[inline(always)]
    pub(super) fn add(&mut self, row: &[f32; UNKNOWNS], residual: f32, weight: f32) {
        for (sums, &own) in self.partial_normal.iter_mut().zip(row) {
            let weighted = weight * own;
            for (sum, &other) in sums.iter_mut().zip(row) {
                *sum += weighted * other;
            }
        }
        let weighted = weight * residual;
        for (sum, &own) in self.partial_right.iter_mut().zip(row) {
            *sum += weighted * own;
        }
        self.added += 1;
        if self.added.is_multiple_of(PARTIAL) {
            self.gather();
        }
    }

    fn gather(&mut self) {
        for (i, sums) in self.partial_normal.iter().enumerate() {
            for (j, &sum) in sums.iter().enumerate() {
                self.normal[(i, j)] += f64::from(sum);
            }
            self.right[i] += f64::from(self.partial_right[i]);
        }
        self.partial_normal = [[0.0; UNKNOWNS]; UNKNOWNS];
        self.partial_right = [0.0; UNKNOWNS];
    }

    /// The step, and the inverse of the normal matrix.
    pub(super) fn solve(mut self) -> Option<(Gradient, Matrix8)> {
        self.gather();
        let inverse = self.normal.cholesky()?.inverse();
        Some((inverse * self.right, inverse))
    }
}
