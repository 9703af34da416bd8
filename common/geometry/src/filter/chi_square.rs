//! Quantiles of the chi-square distribution: what squared Mahalanobis distances stay below.

/// The value that a chi-square variable stays below with this probability. `degrees` of freedom lie
/// above 0 and need not be whole: a mean over correlated samples has fewer than it has summands.
///
/// Clamped to probabilities of 0 to 1 - 1e-12; numbers that are none give 0.
pub fn chi_square_quantile(degrees: f64, probability: f64) -> f64 {
    if !(degrees > 0.0 && degrees.is_finite() && probability > 0.0) {
        return 0.0;
    }
    let wanted = probability.min(1.0 - 1e-12);
    // Its mean is `degrees`, its variance twice that; small ones have long tails.
    let (mut low, mut high) = (0.0, degrees + 12.0 * (2.0 * degrees).sqrt() + 80.0);
    for _ in 0..90 {
        let middle = (low + high) / 2.0;
        if incomplete_gamma(degrees / 2.0, middle / 2.0) < wanted {
            low = middle;
        } else {
            high = middle;
        }
    }
    high
}

/// The squared distance that a right measurement of 6 degrees of freedom stays below with this
/// probability. 0.999 gives 22.46.
pub fn chi_square_gate(probability: f64) -> f64 {
    chi_square_quantile(6.0, probability)
}

/// The regularised lower incomplete gamma function P(a, x), a > 0 (Abramowitz, Stegun, "Handbook of
/// Mathematical Functions", 6.5.29 for small x, 6.5.31 for large).
fn incomplete_gamma(a: f64, x: f64) -> f64 {
    if x <= 0.0 {
        return 0.0;
    }
    let scale = (a * x.ln() - x - ln_gamma(a)).exp();
    if x < a + 1.0 {
        let (mut term, mut sum, mut n) = (1.0 / a, 1.0 / a, a);
        while term > sum * 1e-16 {
            n += 1.0;
            term *= x / n;
            sum += term;
        }
        return scale * sum;
    }
    // Lentz's way to evaluate the continued fraction of 1 - P.
    let tiny = 1e-300;
    let mut b = x + 1.0 - a;
    let (mut c, mut d) = (1.0 / tiny, 1.0 / b);
    let mut fraction = d;
    for n in 1..100_000 {
        let n = f64::from(n);
        let numerator = -n * (n - a);
        b += 2.0;
        let denominator = numerator * d + b;
        d = 1.0 / if denominator.abs() < tiny { tiny } else { denominator };
        c = b + numerator / c;
        if c.abs() < tiny {
            c = tiny;
        }
        fraction *= d * c;
        if (d * c - 1.0).abs() < 1e-15 {
            break;
        }
    }
    1.0 - scale * fraction
}

/// Logarithm of the gamma function of x > 0 (Lanczos, "A precision approximation of the gamma
/// function", 1964, with g = 7 and nine terms).
fn ln_gamma(x: f64) -> f64 {
    const TERMS: [f64; 8] = [
        676.520_368_121_885_1,
        -1_259.139_216_722_402_8,
        771.323_428_777_653_1,
        -176.615_029_162_140_6,
        12.507_343_278_686_905,
        -0.138_571_095_265_720_12,
        9.984_369_578_019_572e-6,
        1.505_632_735_149_311_6e-7,
    ];
    if x < 0.5 {
        // gamma(x) = gamma(x + 1) / x
        return ln_gamma(x + 1.0) - x.ln();
    }
    let x = x - 1.0;
    let sum: f64 = TERMS.iter().zip(1..).map(|(term, k)| term / (x + f64::from(k))).sum();
    let t = x + 7.5;
    0.5 * std::f64::consts::TAU.ln() + (x + 0.5) * t.ln() - t + (0.999_999_999_999_809_9 + sum).ln()
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
    fn the_logarithm_of_gamma_is_that_of_factorials() {
        for (x, factorial) in [(1.0, 1.0), (2.0, 1.0), (5.0, 24.0), (11.0, 3_628_800.0)] {
            assert!((ln_gamma(x) - f64::ln(factorial)).abs() < 1e-12, "{x}");
        }
        // gamma(1/2) = sqrt(pi)
        assert!((ln_gamma(0.5) - std::f64::consts::PI.ln() / 2.0).abs() < 1e-12);
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
