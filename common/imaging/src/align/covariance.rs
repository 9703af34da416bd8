//! The covariance of a fitted pose.
//!
//! The inverse normal matrix is the covariance if the pixels' errors are independent and normal,
//! which they are not. It is multiplied by four corrections:
//!
//! 1. **Robust weights** ([`MEstimator`]): the variance of an M-estimator with Cauchy's weights.
//! 2. **Residual correlation** ([`residual_correlation`]). Views are interpolated, sensors and
//!    codecs smooth, and errors of the model (a fold, a shadow, the soft edge of an arm) extend
//!    over several pixels. The correlation itself would be the factor if the errors were alike
//!    everywhere. But they lie along an arm's edge or over one facet, and move the pose less. With
//!    the whole correlation, NEES on 150 simulated flights fell with its power 0.64 (position) and
//!    0.92 (rotation). So only its power [`CORRELATION_EXPONENT`] is taken, times
//!    [`CORRELATION_FACTOR`].
//! 3. **Degrees of freedom**: residuals are smaller than the noise, because the unknowns absorb a
//!    part.
//! 4. **Wandering**. Near its minimum the sum of squares is a parabola, and a fit needs two or
//!    three steps. Where half a body is hidden or little of it is seen, a fit may wander through a
//!    flat valley until its steps are used up. Then the covariance exceeds that of the normal
//!    matrix ([`WANDERING`]).
//!
//! A cluster-robust covariance, which estimates the correlation for each unknown, has only a few
//! dozen blocks to estimate it from. It was too small by a factor of two.
//!
//! The residuals are those before the last step, less what that step explains.

use nalgebra::{Cholesky, DMatrix, Dyn, Matrix6};

use super::normal_equations::SampleSet;
use super::patch::Patch;
use super::robust::{MEstimator, residual_correlation};

/// The covariance is multiplied by this and by the residual correlation to the power of
/// [`CORRELATION_EXPONENT`]. Both were chosen by NEES on simulated flights, seeds 1001 to 1150.
const CORRELATION_FACTOR: f64 = 1.43;
/// See [`CORRELATION_FACTOR`].
const CORRELATION_EXPONENT: f64 = 0.25;
/// The covariance is multiplied by 1 + (this times how far the fit wandered, in its own standard
/// deviations)².
///
/// It comes from 18,686 poses at 1.6 to 4 m (seeds 9101 to 9114). NEES without it grew from 1.0,
/// where a fit hardly wandered, to 5 and more. With it NEES is 0.8 to 1.2 everywhere
/// (docs/results/constants.md#precision).
const WANDERING: f64 = 0.15;
/// Least share of the independent samples that counts as degrees of freedom.
const MIN_FREE_SHARE: f64 = 0.5;
/// Least share of the residuals' squares that is left after the last step.
const MIN_UNEXPLAINED_SHARE: f64 = 0.5;

/// How residuals depend on each other, and how normal they are.
pub(super) struct Dependence {
    estimator: MEstimator,
    /// Number of usable samples.
    count: usize,
    /// See [`residual_correlation`].
    correlation: f64,
}

impl Dependence {
    /// That of a set's samples, from their `residuals`, `None` where a sample is not usable.
    pub(super) fn of(set: &SampleSet, patch: &Patch, residuals: &[Option<f32>]) -> Self {
        let mut estimator = MEstimator::default();
        let influences: Vec<(usize, f32)> = set
            .samples
            .iter()
            .zip(residuals)
            .filter_map(|(sample, &residual)| {
                let in_sigmas = f64::from(residual?) / set.sigmas[usize::from(sample.facet)];
                let place = usize::from(sample.y) * patch.width + usize::from(sample.x);
                Some((place, estimator.add(in_sigmas) as f32))
            })
            .collect();
        let correlation = residual_correlation(patch.width, patch.height, &influences);
        Self { estimator, count: influences.len(), correlation }
    }

    /// How many times as much the samples count in the normal equations as independent measurements
    /// would, apart from what the unknowns absorb. `None` where most residuals are outliers.
    pub(super) fn weight(&self) -> Option<f64> {
        let correlated = CORRELATION_FACTOR * self.correlation.powf(CORRELATION_EXPONENT);
        Some(self.estimator.factor()? * correlated)
    }

    /// Factor on the inverse normal matrix that makes it a covariance, and covariance of the pose in
    /// the patch's axes: position (m), then rotation vector (rad). `None` where most residuals are
    /// outliers, or the result is not finite.
    ///
    /// `normal` is the normal matrix, factored, and `from_samples` its part that comes from samples,
    /// not from priors. `explained` is the part of the residuals' weighted squares, in standard
    /// deviations, that the last step explains, priors included. `wandered` is the motion of the
    /// pose after its first steps: the sum of all steps, in standard deviations of the inverse
    /// normal matrix.
    pub(super) fn pose_covariance(
        &self,
        normal: &Cholesky<f64, Dyn>,
        from_samples: &DMatrix<f64>,
        explained: f64,
        wandered: f64,
    ) -> Option<(f64, Matrix6<f64>)> {
        let inverse = normal.inverse();
        // Effective degrees of freedom of a ridge regression: the share of each unknown that
        // samples determine and priors do not.
        let independent = self.count as f64 / self.correlation;
        let absorbed = inverse.component_mul(from_samples).sum();
        let free = (independent - absorbed).max(MIN_FREE_SHARE * independent);
        let unexplained = unexplained_share(explained, self.estimator.weighted_squares);
        let factor = self.weight()? * unexplained * independent / free;
        // Divided by the factor, it counts standard deviations of the pose, not of the normal
        // matrix.
        let wandering = 1.0 + (WANDERING * wandered).powi(2) / factor;
        let pose: Matrix6<f64> = inverse.fixed_view::<6, 6>(0, 0) * (factor * wandering);
        pose.iter().all(|x| x.is_finite()).then_some((factor, (pose + pose.transpose()) / 2.0))
    }
}

/// The share of the residuals' `squares` that a step leaves unexplained.
fn unexplained_share(explained: f64, squares: f64) -> f64 {
    (1.0 - explained / squares.max(f64::MIN_POSITIVE)).clamp(MIN_UNEXPLAINED_SHARE, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn at_least_half_of_the_squares_stay_unexplained() {
        let shares = (unexplained_share(30.0, 100.0), unexplained_share(80.0, 100.0));
        assert_eq!(shares, (0.7, MIN_UNEXPLAINED_SHARE));
        assert_eq!((unexplained_share(0.0, 0.0), unexplained_share(-1.0, 100.0)), (1.0, 1.0));
    }
}
