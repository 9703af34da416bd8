//! Robust statistics of residuals: weights, scales, the variance of an M-estimator, and the
//! correlation of neighbouring residuals.

use super::samples::Sample;

/// Scale of Cauchy's weight function, standard deviations.
const CAUCHY_SCALE: f64 = 2.4;
/// Least residual sigma of a facet, share of nominal white: no sensor measures radiance better.
const MIN_SIGMA: f64 = 1.5e-3;
/// Largest residual sigma of a facet, relative to the [`reference_sigma`]. Facets differ in
/// radiance and so in noise, but a facet with much larger residuals is partly occluded, which must
/// not count as noise.
const MAX_RELATIVE_SIGMA: f64 = 3.0;
/// A facet with fewer samples than this takes the residual sigma of all samples together.
const MIN_SAMPLES_FOR_SIGMA: usize = 20;
/// Least ratio of the influence function's mean slope to the mean weight: below, most residuals are
/// outliers.
const MIN_INFLUENCE_SLOPE: f64 = 0.2;
/// Largest distance of neighbours for the correlation of residuals, pixels; farther, the sum
/// gathers noise.
const CORRELATION_REACH_PX: usize = 2;

/// Square of a residual r relative to the scale of Cauchy's function: its weight is 1 / (1 + this).
/// `squared_sigmas` is (r / sigma)^2.
#[inline(always)]
pub(super) fn cauchy_term(squared_sigmas: f64) -> f64 {
    squared_sigmas / CAUCHY_SCALE.powi(2)
}

/// Sums over residuals r, in standard deviations, that give the variance of an M-estimator.
///
/// With psi = w r the influence function and w the weight, the covariance of the solution is
///
/// ```text
/// mean(psi^2) mean(w) / mean(psi')^2
/// ```
///
/// times the inverse normal matrix (Huber, "Robust Statistics", section 7.6). That factor is 0.92
/// for normal noise and larger with outliers.
#[derive(Debug, Default)]
pub(super) struct MEstimator {
    /// Sum of w.
    weights: f64,
    /// Sum of w r^2.
    pub weighted_squares: f64,
    /// Sum of psi^2.
    squares: f64,
    /// Sum of psi', the derivative of the influence function.
    slopes: f64,
}

impl MEstimator {
    /// Adds a residual, in standard deviations, and returns its influence psi.
    pub(super) fn add(&mut self, sigmas: f64) -> f64 {
        let term = cauchy_term(sigmas.powi(2));
        let weight = 1.0 / (1.0 + term);
        let influence = weight * sigmas;
        self.weights += weight;
        self.weighted_squares += influence * sigmas;
        self.squares += influence * influence;
        self.slopes += weight.powi(2) * (1.0 - term);
        influence
    }

    /// The factor of the inverse normal matrix. `None` where most residuals are outliers.
    pub(super) fn factor(&self) -> Option<f64> {
        let is_determined = self.slopes > MIN_INFLUENCE_SLOPE * self.weights;
        is_determined.then(|| self.squares * self.weights / self.slopes.powi(2))
    }
}

/// Number of samples with the information of one independent sample, from the correlation of
/// neighbouring residuals. The variance of a sum of n residuals r is n var(r) times this.
///
/// It is 1 plus the sum of the correlations with all neighbours within [`CORRELATION_REACH_PX`]
/// (the effective sample size of spatially correlated data; Cressie, "Statistics for Spatial Data",
/// section 1.3).
///
/// `influences` has the places of pixels in rows of `width`, and the influence of each residual,
/// standard deviations.
pub(super) fn residual_correlation(
    width: usize,
    height: usize,
    influences: &[(usize, f32)],
) -> f64 {
    // Zero where there is no sample, so that it adds nothing.
    let mut at = vec![0.0f32; width * height];
    for &(place, sigmas) in influences {
        at[place] = sigmas;
    }
    let (mut squares, mut products) = (0.0, 0.0);
    for &(place, sigmas) in influences {
        let (x, y) = (place % width, place / width);
        let columns =
            x.saturating_sub(CORRELATION_REACH_PX)..(x + CORRELATION_REACH_PX + 1).min(width);
        let rows =
            y.saturating_sub(CORRELATION_REACH_PX)..(y + CORRELATION_REACH_PX + 1).min(height);
        let around: f32 = rows.flat_map(|row| &at[row * width..][columns.clone()]).sum();
        squares += f64::from(sigmas * sigmas);
        products += f64::from(sigmas * around);
    }
    (products / squares.max(f64::MIN_POSITIVE)).max(1.0)
}

/// Robust standard deviation of each facet's residuals; `None` for a sample that is not usable.
pub(super) fn facet_sigmas(
    samples: &[Sample],
    residuals: &[Option<f32>],
    facets: usize,
) -> Vec<f64> {
    let mut by_facet: Vec<Vec<f32>> = vec![Vec::new(); facets];
    for (sample, residual) in samples.iter().zip(residuals) {
        by_facet[usize::from(sample.facet)].extend(residual.map(f32::abs));
    }
    let of_all = {
        let mut all: Vec<f32> = residuals.iter().flatten().map(|residual| residual.abs()).collect();
        sigma_from_median(&mut all)
    };
    let mut sigmas: Vec<f64> = by_facet
        .iter_mut()
        .map(|own| if own.len() < MIN_SAMPLES_FOR_SIGMA { of_all } else { sigma_from_median(own) })
        .map(|sigma| sigma.max(MIN_SIGMA))
        .collect();
    let most = MAX_RELATIVE_SIGMA * reference_sigma(&sigmas, samples);
    for sigma in &mut sigmas {
        *sigma = sigma.min(most);
    }
    sigmas
}

/// Residual sigma of facets that nothing occludes: the first quartile over the samples, each with
/// the sigma of its facet.
pub(super) fn reference_sigma(sigmas: &[f64], samples: &[Sample]) -> f64 {
    let mut counts = vec![0usize; sigmas.len()];
    for sample in samples {
        counts[usize::from(sample.facet)] += 1;
    }
    let mut facets: Vec<(f64, usize)> = sigmas.iter().copied().zip(counts).collect();
    facets.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut below = 0;
    for (sigma, count) in facets {
        below += count;
        if 4 * below > samples.len() {
            return sigma;
        }
    }
    MIN_SIGMA
}

/// Standard deviation of normal noise whose absolute values have the same median.
fn sigma_from_median(sizes: &mut [f32]) -> f64 {
    if sizes.is_empty() {
        return 0.0;
    }
    let middle = sizes.len() / 2;
    f64::from(*sizes.select_nth_unstable_by(middle, f32::total_cmp).1) / 0.674_5
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIDE: usize = 60;

    /// Independent noise, uniform between -1 and 1.
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

    fn influences(sigmas: impl Fn(usize, usize) -> f32) -> Vec<(usize, f32)> {
        (0..SIDE * SIDE).map(|place| (place, sigmas(place % SIDE, place / SIDE))).collect()
    }

    #[test]
    fn efficiency_for_normal_noise_is_the_published_one() {
        // Integrated over the normal density.
        let mut estimator = MEstimator::default();
        let density = |x: f64| (-x * x / 2.0).exp();
        let (mut least_squares, mut count) = (0.0, 0.0);
        for step in -4000..=4000 {
            let x = f64::from(step) / 500.0;
            let mut one = MEstimator::default();
            one.add(x);
            estimator.weights += density(x) * one.weights;
            estimator.squares += density(x) * one.squares;
            estimator.slopes += density(x) * one.slopes;
            least_squares += density(x) * x * x;
            count += density(x);
        }
        assert!((least_squares / count - 1.0).abs() < 1e-6);
        // Cauchy's function with c = 2.385 has 95 % of the mean's efficiency; here c is 2.4.
        let variance = count * estimator.squares / estimator.slopes.powi(2);
        assert!((1.0 / variance - 0.951).abs() < 2e-3, "{}", 1.0 / variance);
        let factor = estimator.factor().expect("no outliers");
        assert!((factor - 0.92).abs() < 0.01, "{factor}");
    }

    #[test]
    fn outliers_alone_have_no_covariance_factor() {
        let mut estimator = MEstimator::default();
        for _ in 0..9 {
            estimator.add(8.0);
        }
        assert!(estimator.factor().is_none());
    }

    #[test]
    fn independent_samples_count_fully() {
        let noise = noise();
        let correlation = residual_correlation(SIDE, SIDE, &influences(|x, y| noise[y * SIDE + x]));
        assert!((1.0..1.2).contains(&correlation), "{correlation}");
    }

    #[test]
    fn samples_that_are_means_of_nine_count_as_a_ninth() {
        let noise = noise();
        let mean = |x: usize, y: usize| {
            let rows = y.saturating_sub(1)..(y + 2).min(SIDE);
            let columns = x.saturating_sub(1)..(x + 2).min(SIDE);
            rows.flat_map(|y| &noise[y * SIDE..][columns.clone()]).sum::<f32>() / 9.0
        };
        let correlation = residual_correlation(SIDE, SIDE, &influences(mean));
        assert!((correlation - 9.0).abs() < 1.2, "{correlation}");
    }

    #[test]
    fn zero_residuals_and_no_residuals_are_uncorrelated() {
        assert!(residual_correlation(SIDE, SIDE, &influences(|_, _| 0.0)) == 1.0);
        assert!(residual_correlation(SIDE, SIDE, &[]) == 1.0);
    }
}
