//! Distributions of values, and effective sample sizes.

use flockeye_geometry::statistics::{mean, median, quantile};
use serde::Serialize;

/// The distribution of a magnitude.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Spread {
    /// Mean.
    pub mean: f64,
    /// Median.
    pub median: f64,
    /// 95 % quantile.
    pub p95: f64,
    /// 99 % quantile.
    pub p99: f64,
    /// Largest value.
    pub worst: f64,
}

impl Spread {
    /// The distribution of the values' magnitudes. `None` without values.
    pub fn of(values: impl IntoIterator<Item = f64>) -> Option<Self> {
        let mut sizes: Vec<f64> = values.into_iter().map(f64::abs).collect();
        sizes.sort_by(f64::total_cmp);
        Some(Self {
            mean: mean(&sizes)?,
            median: median(&sizes)?,
            p95: quantile(&sizes, 0.95)?,
            p99: quantile(&sizes, 0.99)?,
            worst: *sizes.last()?,
        })
    }
}

/// The effective sample size: the number of independent samples whose mean has the same variance.
/// It is n / (1 + 2 (r1 + r2 + ...)) with the correlation r at each lag. The sum ends before the
/// first r that is not positive. This is the simplest form of the rule of Geyer ("Practical Markov
/// chain Monte Carlo", 1992). Samples of different series are independent.
pub fn effective_samples(series: &[Vec<f64>]) -> f64 {
    let all: Vec<f64> = series.concat();
    let count = all.len() as f64;
    let Some(mean) = mean(&all) else { return 0.0 };
    let variance = all.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / count;
    if variance <= 0.0 {
        // All samples are equal, so they count as one.
        return 1.0;
    }
    let longest = series.iter().map(Vec::len).max().unwrap_or(0);
    let mut correlated = 0.0;
    for lag in 1..longest {
        let pairs = series.iter().flat_map(|series| series.iter().zip(series.iter().skip(lag)));
        let (sum, pairs) = pairs
            .fold((0.0, 0u32), |(sum, pairs), (a, b)| (sum + (a - mean) * (b - mean), pairs + 1));
        let correlation = sum / f64::from(pairs) / variance;
        if correlation <= 0.0 {
            break;
        }
        // Long lags have fewer pairs, so their weight is smaller.
        correlated += correlation * f64::from(pairs) / count;
    }
    (count / (1.0 + 2.0 * correlated)).max(1.0)
}

/// Effective number of samples of independent runs, with any correlation within a run. All frames
/// of a flight share its path and its light. The variance of the mean is estimated from the sums of
/// the runs. This is the cluster-robust variance (Liang and Zeger, "Longitudinal data analysis
/// using generalized linear models", 1986). With fewer runs than [`FEWEST_RUNS`] it cannot be
/// estimated. Then the result is that of [`effective_samples`].
pub fn effective_samples_of_runs(runs: &[Vec<f64>]) -> f64 {
    let all: Vec<f64> = runs.concat();
    let count_of_runs = runs.iter().filter(|run| !run.is_empty()).count();
    let Some(mean) = mean(&all).filter(|_| count_of_runs >= FEWEST_RUNS) else {
        return effective_samples(runs);
    };
    let squares: f64 = all.iter().map(|value| (value - mean).powi(2)).sum();
    let of_runs = runs.iter().map(|run| run.iter().map(|value| value - mean).sum::<f64>().powi(2));
    let of_runs: f64 = of_runs.sum();
    let (count, runs) = (all.len() as f64, count_of_runs as f64);
    if squares <= 0.0 {
        return 1.0;
    }
    // If the runs do not differ, this divides by zero. The limit then gives all samples.
    (count * squares / of_runs * (runs - 1.0) / runs).clamp(1.0, count)
}

/// Fewest runs for an estimate of the variance between runs. Its standard deviation is then about a
/// third of its value.
const FEWEST_RUNS: usize = 20;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_that_differ_count_for_less() {
        // Each run repeats one number ten times: ten samples count as one.
        let alike: Vec<Vec<f64>> = (0..40).map(|run| vec![f64::from(run % 2); 10]).collect();
        let found = effective_samples_of_runs(&alike);
        assert!((found - 40.0 * 39.0 / 40.0).abs() < 1e-9, "{found}");
        // Each has the same two numbers: runs do not differ.
        let unlike: Vec<Vec<f64>> = (0..40).map(|_| vec![0.0, 1.0]).collect();
        assert_eq!(effective_samples_of_runs(&unlike), 80.0);
        assert_eq!(effective_samples_of_runs(&vec![vec![2.0]; 30]), 1.0);
        // Independent samples count in full.
        let mut state = 3u64;
        let mut noise = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            (state >> 11) as f64 / (1u64 << 53) as f64
        };
        let free: Vec<Vec<f64>> = (0..2000).map(|_| vec![noise(), noise()]).collect();
        let share = effective_samples_of_runs(&free) / 4000.0;
        assert!((share - 1.0).abs() < 0.1, "{share}");
    }

    #[test]
    fn few_runs_fall_back_to_the_correlation_in_time() {
        let few = [vec![1.0, 1.0, -1.0, -1.0]];
        assert_eq!(effective_samples_of_runs(&few), effective_samples(&few));
        assert_eq!(effective_samples_of_runs(&[]), 0.0);
    }

    #[test]
    fn spreads_are_those_computed_by_hand() {
        let spread = Spread::of([3.0, -1.0, 2.0, 4.0]).expect("there are some");
        assert_eq!(spread, Spread { mean: 2.5, median: 2.5, p95: 4.0, p99: 4.0, worst: 4.0 });
        assert_eq!(Spread::of([]), None);
    }

    #[test]
    fn correlated_samples_count_for_less() {
        // By hand: mean 0, variance 1, r1 = -1/3 ends the sum at once.
        assert_eq!(effective_samples(&[vec![1.0, -1.0, -1.0, 1.0]]), 4.0);
        // Mean 0, variance 1; r1 = (1 - 1 + 1)/3 of 3 pairs, r2 = (-1 - 1)/2 ends it:
        // 4 / (1 + 2 * 1/3 * 3/4) = 4 / 1.5.
        let found = effective_samples(&[vec![1.0, 1.0, -1.0, -1.0]]);
        assert!((found - 4.0 / 1.5).abs() < 1e-12, "{found}");
        // Two series of one sample each have no lag.
        assert_eq!(effective_samples(&[vec![1.0], vec![-1.0]]), 2.0);
        assert_eq!(effective_samples(&[vec![2.0; 9]]), 1.0);
        assert_eq!(effective_samples(&[]), 0.0);
    }

    #[test]
    fn a_known_correlation_is_found() {
        // x' = 0.8 x + noise: the mean of n is worth n (1 - 0.8) / (1 + 0.8) samples.
        let (mut state, mut x) = (7u64, 0.0);
        let mut noise = || {
            // Uniform numbers by Knuth's generator (MMIX).
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1u64 << 53) as f64 - 0.5
        };
        let series: Vec<f64> = (0..20_000)
            .map(|_| {
                x = 0.8 * x + noise();
                x
            })
            .collect();
        let share = effective_samples(&[series]) / 20_000.0;
        assert!((share - 1.0 / 9.0).abs() < 0.02, "{share}");
    }
}
