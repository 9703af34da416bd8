//! The covariance of a fitted pose.
//!
//! The inverse normal matrix is the covariance if the pixels' errors are independent and normal, which
//! they are not. It is multiplied by four corrections:
//!
//! 1. **Robust weights** ([`MEstimator`]): the variance of an M-estimator with Cauchy's weights.
//! 2. **Residual correlation** ([`residual_correlation`]). Views are interpolated, sensors and codecs
//!    smooth, and errors of the model (a fold, a shadow, the soft edge of an arm) extend over several
//!    pixels. The measured correlation would multiply the covariance if the errors were alike everywhere.
//!    They are not: they lie along an arm's edge or over one facet, and move the pose less. On 150
//!    simulated flights, NEES fell with the correlation's power 0.64 (position) and 0.92 (rotation) where
//!    the whole correlation was taken. So only its power [`CORRELATION_EXPONENT`] is taken, times
//!    [`CORRELATION_FACTOR`].
//! 3. **Degrees of freedom**: residuals are smaller than the noise by what the unknowns absorb.
//! 4. **Wandering**. The normal matrix describes the sum of squares near its minimum as a parabola, and there a fit needs
//!    two or three steps. Where half a body is hidden or little of it is seen, a fit may wander through a flat valley
//!    until its steps are used up. Then the pose is less certain than the parabola says ([`WANDERING`]).
//!
//! A cluster-robust covariance, which estimates the correlation for each unknown, has only a few dozen
//! blocks to estimate it from. It was too small by a factor of two.
//!
//! The residuals are those before the last step. What that step explains of their squares is taken off.

use nalgebra::{Cholesky, DMatrix, Dyn, Matrix6};

use super::patch::Patch;
use super::robust::{Influence, MEstimator, residual_correlation};
use super::samples::Sample;

/// The covariance is multiplied by this and by the residual correlation to the power of
/// [`CORRELATION_EXPONENT`]. Both were chosen by NEES on simulated flights, seeds 1001 to 1150.
const CORRELATION_FACTOR: f64 = 1.43;
/// See [`CORRELATION_FACTOR`].
const CORRELATION_EXPONENT: f64 = 0.25;
/// The covariance is multiplied by 1 + (this times how far the fit wandered, in its own standard deviations)².
///
/// Read from 18,686 poses at 1.6 to 4 m (seeds 9101 to 9114). NEES without it grew from 1.0 where a fit hardly wandered to 5
/// and more. With it NEES is 0.8 to 1.2 everywhere (docs/results/constants.md#precision).
const WANDERING: f64 = 0.15;
/// Least share of the independent samples that counts as degrees of freedom.
const MIN_FREE_SHARE: f64 = 0.5;
/// Least share of the residuals' squares that is left after the last step.
const MIN_UNEXPLAINED_SHARE: f64 = 0.5;

/// A solved system of normal equations and the residuals that it was made of.
pub(super) struct Solved<'s> {
    /// The normal matrix, factored.
    pub normal: &'s Cholesky<f64, Dyn>,
    /// The part of the normal matrix that comes from samples, not from priors.
    pub from_samples: &'s DMatrix<f64>,
    /// How much of the weighted squares of the residuals, in standard deviations, the last step explains,
    /// priors included.
    pub explained: f64,
    /// How far the pose moved after its first steps, the sum of all steps, in standard deviations of the inverse normal
    /// matrix.
    pub wandered: f64,
    /// The residuals, one for each sample; `None` where a sample says nothing.
    pub residuals: &'s [Option<f32>],
    /// Residual sigma of each facet.
    pub sigmas: &'s [f64],
}

/// Covariance of the pose in the patch's axes: position (m), then rotation vector (rad). `None` where
/// most residuals are outliers, or the result is not finite.
pub(super) fn of_pose(
    solved: &Solved<'_>,
    patch: &Patch,
    samples: &[Sample],
) -> Option<Matrix6<f64>> {
    let Solved { normal, from_samples, explained, wandered, residuals, sigmas } = *solved;
    let inverse = normal.inverse();
    let mut estimator = MEstimator::default();
    let influences: Vec<Influence> = samples
        .iter()
        .zip(residuals)
        .filter_map(|(sample, &residual)| {
            let in_sigmas = f64::from(residual?) / sigmas[usize::from(sample.facet)];
            Some(Influence {
                x: usize::from(sample.x),
                y: usize::from(sample.y),
                sigmas: estimator.add(in_sigmas) as f32,
            })
        })
        .collect();
    let correlation = residual_correlation(patch.width, patch.height, &influences);
    // Effective degrees of freedom of a ridge regression: of each unknown, the share that samples
    // determine and priors do not.
    let independent = influences.len() as f64 / correlation;
    let absorbed = inverse.component_mul(from_samples).sum();
    let free = (independent - absorbed).max(MIN_FREE_SHARE * independent);
    let unexplained = unexplained_share(explained, estimator.weighted_squares);
    let correlated = CORRELATION_FACTOR * correlation.powf(CORRELATION_EXPONENT);
    let factor = estimator.factor()? * unexplained * correlated * independent / free;
    // In standard deviations of the pose, not of the inverse normal matrix.
    let wandering = 1.0 + (WANDERING * wandered).powi(2) / factor;
    let pose: Matrix6<f64> = inverse.fixed_view::<6, 6>(0, 0) * (factor * wandering);
    pose.iter().all(|x| x.is_finite()).then_some((pose + pose.transpose()) / 2.0)
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
