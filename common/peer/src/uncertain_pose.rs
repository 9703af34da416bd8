//! A pose with its covariance.
//!
//! The error is (position, rotation vector), both in the axes of `a`: `p_true = p + dp`, `R_true =
//! exp(dr) R`. It is the same everywhere in this project. The perturbation is on the left, and the
//! position is separate (Barfoot, "State Estimation for Robotics", section 7.3).

use flockeye_geometry::pose::{moved, pose_difference};
use nalgebra::{Isometry3, Matrix3, Matrix6, Vector6};

/// A pose `a_from_b` and the covariance of its error.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct UncertainPose {
    /// The pose: `p_a = R p_b + position`, metres.
    pub a_from_b: Isometry3<f64>,
    /// Covariance of position (m), then rotation vector (rad), in the axes of a.
    pub covariance: Matrix6<f64>,
}

impl UncertainPose {
    /// Whether all numbers are finite and the covariance is positive definite.
    pub fn is_usable(&self) -> bool {
        self.a_from_b.to_homogeneous().iter().all(|x| x.is_finite())
            && self.covariance.iter().all(|x| x.is_finite())
            && self.covariance.cholesky().is_some()
    }

    /// `b_from_a`, with the covariance in the axes of b.
    pub fn inverse(&self) -> Self {
        let b_from_a = self.a_from_b.inverse();
        let turn = b_from_a.rotation.to_rotation_matrix().into_inner();
        let lever = turn * self.a_from_b.translation.vector.cross_matrix();
        let jacobian = blocks(&-turn, &-lever, &-turn);
        Self { a_from_b: b_from_a, covariance: propagated(&jacobian, &self.covariance) }
    }

    /// `a_from_c` from this pose and `b_from_c`, whose errors are independent.
    pub fn then(&self, b_from_c: &Self) -> Self {
        let turn = self.a_from_b.rotation.to_rotation_matrix().into_inner();
        let arm = turn * b_from_c.a_from_b.translation.vector;
        let of_first = blocks(&Matrix3::identity(), &-arm.cross_matrix(), &Matrix3::identity());
        let of_second = blocks(&turn, &Matrix3::zeros(), &turn);
        Self {
            a_from_b: self.a_from_b * b_from_c.a_from_b,
            covariance: propagated(&of_first, &self.covariance)
                + propagated(&of_second, &b_from_c.covariance),
        }
    }

    /// The error of `other` relative to this pose, in the axes of a.
    pub fn difference(&self, other: &Isometry3<f64>) -> Vector6<f64> {
        pose_difference(other, &self.a_from_b)
    }

    /// This pose moved by an error in the axes of a.
    pub fn moved(&self, error: &Vector6<f64>) -> Self {
        Self { a_from_b: moved(&self.a_from_b, error), covariance: self.covariance }
    }

    /// Combines two estimates of one pose with unknown correlation by covariance intersection
    /// (Julier and Uhlmann, 1997). Its covariance is never too small, whatever the correlation.
    /// None if one of the covariances cannot be inverted.
    pub fn intersection(&self, other: &Self) -> Option<Self> {
        let ours = self.covariance.cholesky()?.inverse();
        let theirs = other.covariance.cholesky()?.inverse();
        let at = |share: f64| -> Option<Matrix6<f64>> {
            Some((ours * share + theirs * (1.0 - share)).cholesky()?.inverse())
        };
        // The determinant of the result is convex in the share, so golden-section search finds its
        // minimum.
        let ratio = (5f64.sqrt() - 1.0) / 2.0;
        let (mut low, mut high) = (0.0, 1.0);
        for _ in 0..24 {
            let width = ratio * (high - low);
            let (left, right) = (high - width, low + width);
            if at(left)?.determinant() < at(right)?.determinant() {
                high = right;
            } else {
                low = left;
            }
        }
        let share = (low + high) / 2.0;
        let covariance = at(share)?;
        let towards = theirs * (1.0 - share) * self.difference(&other.a_from_b);
        Some(Self { a_from_b: moved(&self.a_from_b, &(covariance * towards)), covariance })
    }
}

/// The block matrix of `top_left`, `top_right`, zero and `bottom_right`.
pub(crate) fn blocks(
    top_left: &Matrix3<f64>,
    top_right: &Matrix3<f64>,
    bottom_right: &Matrix3<f64>,
) -> Matrix6<f64> {
    let mut matrix = Matrix6::zeros();
    matrix.fixed_view_mut::<3, 3>(0, 0).copy_from(top_left);
    matrix.fixed_view_mut::<3, 3>(0, 3).copy_from(top_right);
    matrix.fixed_view_mut::<3, 3>(3, 3).copy_from(bottom_right);
    matrix
}

fn propagated(jacobian: &Matrix6<f64>, covariance: &Matrix6<f64>) -> Matrix6<f64> {
    let product = jacobian * covariance * jacobian.transpose();
    // Rounding may make it asymmetric.
    (product + product.transpose()) / 2.0
}
