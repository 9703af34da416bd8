//! Means and quantiles.

use serde::Serialize;

/// How a size is spread.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Spread {
    /// Its mean.
    pub mean: f64,
    /// Half are smaller.
    pub median: f64,
    /// 95 % are smaller.
    pub p95: f64,
    /// The largest.
    pub worst: f64,
}

impl Spread {
    /// Of sizes; `None` if there is none. Signs do not count.
    pub fn of(values: impl IntoIterator<Item = f64>) -> Option<Self> {
        let mut sizes: Vec<f64> = values.into_iter().map(f64::abs).collect();
        sizes.sort_by(f64::total_cmp);
        Some(Self {
            mean: mean(&sizes)?,
            median: quantile(&sizes, 0.5)?,
            p95: quantile(&sizes, 0.95)?,
            worst: *sizes.last()?,
        })
    }
}

/// The value below which `share` of the rising `values` lie (nearest rank).
pub fn quantile(values: &[f64], share: f64) -> Option<f64> {
    let rank = (share * values.len() as f64).ceil() as usize;
    values.get(rank.saturating_sub(1)).copied()
}

/// The mean; `None` of nothing.
pub fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// How many independent samples tell as much of the mean as these do: n / (1 + 2 (r1 + r2 + ...)),
/// r the correlation at each lag, up to the first that is not positive (Geyer, "Practical Markov
/// chain Monte Carlo", 1992, in its plainest form). Samples of different series are independent.
pub fn effective_samples(series: &[Vec<f64>]) -> f64 {
    let all: Vec<f64> = series.concat();
    let count = all.len() as f64;
    let Some(mean) = mean(&all) else { return 0.0 };
    let variance = all.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / count;
    if variance <= 0.0 {
        // They are all the same: one value, said so many times.
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
        // Few pairs lie far apart.
        correlated += correlation * f64::from(pairs) / count;
    }
    (count / (1.0 + 2.0 * correlated)).max(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spreads_are_those_computed_by_hand() {
        let spread = Spread::of([3.0, -1.0, 2.0, 4.0]).expect("there are some");
        assert_eq!(spread, Spread { mean: 2.5, median: 2.0, p95: 4.0, worst: 4.0 });
        assert_eq!(Spread::of([]), None);
        let rising: Vec<f64> = (1..=100).map(f64::from).collect();
        assert_eq!((quantile(&rising, 0.95), quantile(&rising, 0.99)), (Some(95.0), Some(99.0)));
        assert_eq!((quantile(&rising, 0.0), quantile(&[], 0.5)), (Some(1.0), None));
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
            // Even numbers by Knuth's generator (MMIX).
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
