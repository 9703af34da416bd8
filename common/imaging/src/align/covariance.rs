//! The covariance of a fitted pose.
//!
//! The inverse normal matrix believes that the pixels' errors are independent. They are not: views are
//! interpolated, sensors and codecs smooth, and what the model does not know (a fold, a shadow, an
//! arm's soft edge) is wrong over several pixels. How much errors go together is measured from what the
//! fit leaves over: with r the residuals, the variance of a sum of n of them is
//!
//! ```text
//! n var(r) (1 + sum of their correlation with each neighbour)
//! ```
//!
//! and the bracket would multiply the covariance (the effective sample size of spatially correlated data;
//! Cressie, "Statistics for Spatial Data", section 1.3), with the degrees of freedom that the unknowns
//! take, if what goes together were alike everywhere. It is not: what the model does not know lies along
//! an arm's edge or over one facet, and moves the pose less than the bracket says. On 150 simulated flights
//! NEES fell with the bracket's power 0.64 (position) and 0.92 (rotation) where the whole bracket was
//! taken, so that the fit's own value is drawn three quarters of the way to the one value that suits all.
//! A cluster-robust covariance, which finds it for each unknown by itself, has a few dozen blocks to find
//! it from and was twice too small.
//!
//! Weights make the normal matrix smaller than what the residuals tell. With psi the weighted residual,
//! in deviations, and w its weight, the solution's covariance is that of an M-estimator (Huber, "Robust
//! Statistics", section 7.6),
//!
//! ```text
//! mean(psi^2) mean(w) / mean(psi')^2
//! ```
//!
//! times the inverse normal matrix: 0.92 for normal noise, more where outliers are left. The residuals are
//! those before the last step; what it explains of their squares is taken off.

use nalgebra::{Cholesky, DMatrix, Dyn, Matrix6};

use super::patch::Patch;
use super::samples::Sample;
use super::sums::damping;

/// Neighbours within so many pixels along each axis are asked. Farther, the sum gathers noise.
const REACH: usize = 2;
/// Covariances are multiplied by this and by the `OWN`th power of what the fit's residuals say: chosen on
/// simulated flights, seeds 1001 to 1150, by NEES.
const TYPICAL: f64 = 1.43;
const OWN: f64 = 0.25;
/// However few samples there are, some are left.
const LEAST_FREE: f64 = 0.5;
/// However much the last step explains, some is left.
const LEAST_LEFT: f64 = 0.5;

/// Covariance of position (m) and rotation vector, in the patch's axes, of a fit with this normal matrix,
/// factored, and these residuals, of whose weighted squares, in deviations, the last step `explains` so
/// much, priors included. `seen` is what of the normal matrix comes from samples, not priors. `None` where
/// it is none.
pub(super) fn of_pose(
    normal: &Cholesky<f64, Dyn>,
    seen: &DMatrix<f64>,
    explains: f64,
    patch: &Patch,
    samples: &[Sample],
    residuals: &[f32],
    scales: &[f64],
) -> Option<Matrix6<f64>> {
    let inverse = normal.inverse();
    let mut robust = Robust::default();
    let felt: Vec<Felt> = samples
        .iter()
        .zip(residuals)
        .map(|(sample, &residual)| {
            let deviations = f64::from(residual) / scales[usize::from(sample.facet)];
            Felt {
                x: usize::from(sample.x),
                y: usize::from(sample.y),
                deviations: robust.take(deviations) as f32,
            }
        })
        .collect();
    let together = together(patch.width, patch.height, &felt);
    // What is left over is less than the noise by what the unknowns took of it: each the share in which
    // samples, and no prior, say what it is (the effective degrees of freedom of a ridge regression).
    let independent = samples.len() as f64 / together;
    let taken = inverse.component_mul(seen).sum();
    let free = (independent - taken).max(LEAST_FREE * independent);
    let left = left(explains, robust.weighted_squares);
    let goes_together = TYPICAL * together.powf(OWN);
    let factor = robust.factor()? * left * goes_together * independent / free;
    let pose: Matrix6<f64> = inverse.fixed_view::<6, 6>(0, 0) * factor;
    pose.iter().all(|x| x.is_finite()).then_some((pose + pose.transpose()) / 2.0)
}

/// The share of the residuals' `squares` that is left after a step that `explains` so much of them.
fn left(explains: f64, squares: f64) -> f64 {
    (1.0 - explains / squares.max(f64::MIN_POSITIVE)).clamp(LEAST_LEFT, 1.0)
}

/// Sums over residuals r in deviations: of their weights w, of w r^2, of psi = w r, squared, and of psi's
/// slope.
#[derive(Debug, Default)]
struct Robust {
    weights: f64,
    weighted_squares: f64,
    squares: f64,
    slopes: f64,
}

impl Robust {
    /// Takes in a residual, and gives it weighted.
    fn take(&mut self, deviations: f64) -> f64 {
        let damping = damping(deviations.powi(2));
        let weight = 1.0 / (1.0 + damping);
        let felt = weight * deviations;
        self.weights += weight;
        self.weighted_squares += felt * deviations;
        self.squares += felt * felt;
        self.slopes += weight.powi(2) * (1.0 - damping);
        felt
    }

    /// What the inverse normal matrix is to be multiplied by. `None` where most residuals are outliers.
    fn factor(&self) -> Option<f64> {
        let is_told = self.slopes > LEAST_SLOPE * self.weights;
        is_told.then(|| self.squares * self.weights / self.slopes.powi(2))
    }
}

/// Where psi's slope is less than this share of the weights, on average, it falls for most residuals.
const LEAST_SLOPE: f64 = 0.2;

/// A pixel's residual, as the solution feels it.
struct Felt {
    x: usize,
    y: usize,
    deviations: f32,
}

/// How many samples count as one.
fn together(width: usize, height: usize, felt: &[Felt]) -> f64 {
    // Zero where there is no sample: it adds nothing.
    let mut at = vec![0.0f32; width * height];
    for own in felt {
        at[own.y * width + own.x] = own.deviations;
    }
    let (mut squares, mut products) = (0.0, 0.0);
    for &Felt { x, y, deviations } in felt {
        let columns = x.saturating_sub(REACH)..(x + REACH + 1).min(width);
        let rows = y.saturating_sub(REACH)..(y + REACH + 1).min(height);
        let around: f32 = rows.flat_map(|row| &at[row * width..][columns.clone()]).sum();
        squares += f64::from(deviations * deviations);
        products += f64::from(deviations * around);
    }
    (products / squares.max(f64::MIN_POSITIVE)).max(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIDE: usize = 60;

    /// Noise of no kind of order, evenly between -1 and 1.
    fn noise() -> Vec<f32> {
        let mut state = 0x9e37_79b9_u64;
        let mut random = || {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 40) as f32 / (1 << 23) as f32 - 1.0
        };
        (0..SIDE * SIDE).map(|_| random()).collect()
    }

    fn felt(deviation: impl Fn(usize, usize) -> f32) -> Vec<Felt> {
        let places = (0..SIDE).flat_map(|y| (0..SIDE).map(move |x| (x, y)));
        places.map(|(x, y)| Felt { x, y, deviations: deviation(x, y) }).collect()
    }

    #[test]
    fn normal_noise_makes_the_estimator_as_efficient_as_is_published() {
        // Integrated over the normal density.
        let mut robust = Robust::default();
        let density = |x: f64| (-x * x / 2.0).exp();
        let (mut least_squares, mut count) = (0.0, 0.0);
        for step in -4000..=4000 {
            let x = f64::from(step) / 500.0;
            let mut one = Robust::default();
            one.take(x);
            robust.weights += density(x) * one.weights;
            robust.squares += density(x) * one.squares;
            robust.slopes += density(x) * one.slopes;
            least_squares += density(x) * x * x;
            count += density(x);
        }
        assert!((least_squares / count - 1.0).abs() < 1e-6);
        // Cauchy's function with c = 2.385 has 95 % of the mean's efficiency; here c is 2.4.
        let variance = count * robust.squares / robust.slopes.powi(2);
        assert!((1.0 / variance - 0.951).abs() < 2e-3, "{}", 1.0 / variance);
        let factor = robust.factor().expect("no outliers");
        assert!((factor - 0.92).abs() < 0.01, "{factor}");
    }

    #[test]
    fn outliers_alone_say_nothing() {
        let mut robust = Robust::default();
        for _ in 0..9 {
            robust.take(8.0);
        }
        assert!(robust.factor().is_none());
    }

    #[test]
    fn samples_that_know_nothing_of_each_other_count_fully() {
        let noise = noise();
        let together = together(SIDE, SIDE, &felt(|x, y| noise[y * SIDE + x]));
        assert!((1.0..1.2).contains(&together), "{together}");
    }

    #[test]
    fn samples_that_are_means_of_nine_count_as_a_ninth() {
        let noise = noise();
        let mean = |x: usize, y: usize| {
            let rows = y.saturating_sub(1)..(y + 2).min(SIDE);
            let columns = x.saturating_sub(1)..(x + 2).min(SIDE);
            rows.flat_map(|y| &noise[y * SIDE..][columns.clone()]).sum::<f32>() / 9.0
        };
        let together = together(SIDE, SIDE, &felt(mean));
        assert!((together - 9.0).abs() < 1.2, "{together}");
    }

    #[test]
    fn a_step_leaves_what_it_does_not_explain_or_half() {
        assert_eq!((left(30.0, 100.0), left(80.0, 100.0)), (0.7, LEAST_LEFT));
        assert_eq!((left(0.0, 0.0), left(-1.0, 100.0)), (1.0, 1.0));
    }

    #[test]
    fn no_residual_says_nothing() {
        assert!(together(SIDE, SIDE, &felt(|_, _| 0.0)) == 1.0);
        assert!(together(SIDE, SIDE, &[]) == 1.0);
    }
}
