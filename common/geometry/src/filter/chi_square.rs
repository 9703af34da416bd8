//! Quantiles of the chi-square distribution, as gates for squared Mahalanobis distances.

use statrs::function::gamma::checked_gamma_lr;

/// Quantile of the chi-square distribution at this probability. `degrees` of freedom are above 0
/// and need not be whole: a mean over correlated samples has fewer of them than summands.
///
/// Probabilities are clamped to 0 to 1 - 1e-12; NaN gives 0.
pub fn chi_square_quantile(degrees: f64, probability: f64) -> f64 {
    if !(degrees > 0.0 && degrees.is_finite() && probability > 0.0) {
        return 0.0;
    }
    let wanted = probability.min(1.0 - 1e-12);
    // The upper limit follows from the mean, `degrees`, and the variance, twice that. Small degrees
    // have long tails.
    let (mut low, mut high) = (0.0, degrees + 12.0 * (2.0 * degrees).sqrt() + 80.0);
    for _ in 0..90 {
        let middle = (low + high) / 2.0;
        // The only error is an argument that is not positive and finite: the quantile is 0 then.
        let share = checked_gamma_lr(degrees / 2.0, middle / 2.0).unwrap_or(0.0);
        if share < wanted {
            low = middle;
        } else {
            high = middle;
        }
    }
    high
}

/// Gate of the squared distance for 6 degrees of freedom: a right measurement passes with this
/// probability. 0.999 gives 22.46.
pub fn chi_square_gate(probability: f64) -> f64 {
    chi_square_quantile(6.0, probability)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Tables of the chi-square distribution, as in any book of statistics.
    #[test]
    fn quantiles_are_those_of_the_tables() {
        for (degrees, probability, quantile) in [
            (1.0, 0.95, 3.841_459),
            (2.0, 0.5, 1.386_294),
            (3.0, 0.5, 2.365_974),
            (3.0, 0.025, 0.215_795),
            (3.0, 0.975, 9.348_404),
            (6.0, 0.999, 22.457_745),
            (10.0, 0.05, 3.940_299),
            (100.0, 0.95, 124.342_113),
            (150.0, 0.025, 117.984_5),
            (150.0, 0.975, 185.800_4),
            (1000.0, 0.975, 1_089.530_9),
        ] {
            let found = chi_square_quantile(degrees, probability);
            assert!(
                (found - quantile).abs() < 2e-4,
                "{degrees} degrees, {probability}: {found}, not {quantile}"
            );
        }
    }

    #[test]
    fn what_is_no_distribution_gives_zero() {
        for (degrees, probability) in [(0.0, 0.5), (-1.0, 0.5), (f64::NAN, 0.5), (3.0, f64::NAN)] {
            assert_eq!(chi_square_quantile(degrees, probability), 0.0);
        }
        assert!(chi_square_quantile(3.0, 1.0).is_finite());
        // For many degrees it is a normal distribution.
        let many = chi_square_quantile(1e6, 0.5);
        assert!((many - (1e6 - 2.0 / 3.0)).abs() < 0.01, "{many}");
    }
}
