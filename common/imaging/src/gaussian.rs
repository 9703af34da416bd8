//! The unit Gaussian, tabulated.

use std::f64::consts::FRAC_1_SQRT_2;
use std::sync::LazyLock;

/// The Gaussian is truncated at this many standard deviations. The density is lowered by its value
/// there, and scaled so that the distribution goes from 0 to 1. So neither function has a step.
pub(crate) const REACH: f32 = 3.6;
/// Steps of the table per standard deviation: linear interpolation is exact to 1e-5.
const STEPS: f32 = 128.0;
const HALF: usize = (REACH * STEPS) as usize + 2;

/// Density and distribution function at -HALF to HALF steps.
static TABLE: LazyLock<Vec<[f32; 2]>> = LazyLock::new(|| {
    let at = |step: usize| (step as f64 - HALF as f64) / f64::from(STEPS);
    let end = f64::from(REACH);
    let (floor, tail) = density_and_distribution(-end);
    let kept = 1.0 - 2.0 * tail - 2.0 * floor * end;
    (0..=2 * HALF)
        .map(|step| {
            let z = at(step).clamp(-end, end);
            let (density, below) = density_and_distribution(z);
            let above_floor = below - tail - floor * (z + end);
            [((density - floor) / kept) as f32, (above_floor / kept) as f32]
        })
        .collect()
});

/// The table. Callers get it once for many samples.
#[derive(Clone, Copy)]
pub(crate) struct Gaussian(&'static [[f32; 2]]);

impl Gaussian {
    pub(crate) fn get() -> Self {
        Self(&TABLE)
    }

    /// Density and distribution function at `z`. Beyond [`REACH`] they are constant.
    #[inline]
    pub(crate) fn at(&self, z: f32) -> (f32, f32) {
        // A NaN becomes the lower end.
        let place = (z.clamp(-REACH, REACH) + REACH) * STEPS + (HALF as f32 - REACH * STEPS);
        // Processors have no instruction from float to `usize`; it would take longer than the rest.
        let step = place as u16;
        let (index, share) = (usize::from(step), place - f32::from(step));
        let ([d0, b0], [d1, b1]) = (self.0[index], self.0[index + 1]);
        (d0 + (d1 - d0) * share, b0 + (b1 - b0) * share)
    }
}

/// Density and distribution function of the unit Gaussian at `a`, exact to 1e-7 (Abramowitz and
/// Stegun, 7.1.26, which uses the density's exponential).
pub(crate) fn density_and_distribution(a: f64) -> (f64, f64) {
    let exponential = (-0.5 * a * a).exp();
    let t = 1.0 / (1.0 + 0.327_591_1 * a.abs() * FRAC_1_SQRT_2);
    let polynomial = t
        * (0.254_829_592
            + t * (-0.284_496_736
                + t * (1.421_413_741 + t * (-1.453_152_027 + t * 1.061_405_429))));
    let tail = 0.5 * polynomial * exponential;
    let below = if a < 0.0 { tail } else { 1.0 - tail };
    (0.398_942_280_401_432_7 * exponential, below)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn density_and_distribution_have_their_published_values() {
        for (a, density, below) in [
            (0.0, 0.398_942_3, 0.5),
            (1.0, 0.241_970_7, 0.841_344_7),
            (-1.96, 0.058_440_9, 0.024_997_9),
            (3.0, 0.004_431_8, 0.998_650_1),
        ] {
            let (d, b) = density_and_distribution(a);
            assert!((d - density).abs() < 2e-7 && (b - below).abs() < 2e-7, "at {a}: {d} {b}");
        }
    }

    #[test]
    fn the_table_is_the_truncated_gaussian() {
        let gaussian = Gaussian::get();
        for (z, end) in [(-REACH, 0.0), (-9.0, 0.0), (REACH, 1.0), (9.0, 1.0)] {
            let (density, below) = gaussian.at(z);
            assert!(density.abs() < 1e-5 && (below - end).abs() < 1e-5, "{z}: {density}, {below}");
        }
        let mut before = 0.0;
        for step in -3600..=3600i16 {
            let z = f32::from(step) / 1000.0;
            let (density, below) = gaussian.at(z);
            let (exact, exact_below) = density_and_distribution(f64::from(z));
            // Truncation moves half a percent of the density to the middle.
            assert!((f64::from(density) - exact).abs() < 2e-3, "{z}: {density}, {exact}");
            assert!((f64::from(below) - exact_below).abs() < 2e-3, "{z}: {below}, {exact_below}");
            assert!(below >= before, "{z}");
            before = below;
            let slope = (gaussian.at(z + 0.05).1 - gaussian.at(z - 0.05).1) / 0.1;
            assert!((slope - density).abs() < 1e-3, "{z}: {slope}, {density}");
        }
    }
}
