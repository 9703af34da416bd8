//! The unit Gaussian, from a table.

use std::f64::consts::FRAC_1_SQRT_2;
use std::sync::LazyLock;

/// Beyond so many standard deviations there is nothing: the density is lowered by what it has
/// there, and stretched so that the distribution goes from 0 to 1. So neither has a step.
pub(crate) const REACH: f32 = 3.6;
/// Steps of the table for each standard deviation: linear between them is right to 1e-5.
const STEPS: f32 = 128.0;
const HALF: usize = (REACH * STEPS) as usize + 2;

/// Density and distribution function, at -HALF to HALF steps.
static TABLE: LazyLock<Vec<[f32; 2]>> = LazyLock::new(|| {
    let at = |step: usize| (step as f64 - HALF as f64) / f64::from(STEPS);
    let end = f64::from(REACH);
    let (floor, tail) = density_and_share(-end);
    let kept = 1.0 - 2.0 * tail - 2.0 * floor * end;
    (0..=2 * HALF)
        .map(|step| {
            let z = at(step).clamp(-end, end);
            let (density, below) = density_and_share(z);
            let above_floor = below - tail - floor * (z + end);
            [((density - floor) / kept) as f32, (above_floor / kept) as f32]
        })
        .collect()
});

/// The table, looked up once for a whole run over samples.
#[derive(Clone, Copy)]
pub(crate) struct Gaussian(&'static [[f32; 2]]);

impl Gaussian {
    pub(crate) fn get() -> Self {
        Self(&TABLE)
    }

    /// Density and distribution function at `z`; beyond [`REACH`] they stay as they are there.
    #[inline]
    pub(crate) fn at(&self, z: f32) -> (f32, f32) {
        // A NaN becomes the lower end.
        let place = (z.clamp(-REACH, REACH) + REACH) * STEPS + (HALF as f32 - REACH * STEPS);
        let index = place as usize;
        let share = place - index as f32;
        let ([d0, b0], [d1, b1]) = (self.0[index], self.0[index + 1]);
        (d0 + (d1 - d0) * share, b0 + (b1 - b0) * share)
    }
}

/// Density and distribution function of the unit Gaussian at `a`, to 1e-7 (Abramowitz and Stegun,
/// 7.1.26, which shares the exponential with the density).
pub(crate) fn density_and_share(a: f64) -> (f64, f64) {
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
    fn the_gaussian_is_the_tables_one() {
        for (a, density, below) in [
            (0.0, 0.398_942_3, 0.5),
            (1.0, 0.241_970_7, 0.841_344_7),
            (-1.96, 0.058_440_9, 0.024_997_9),
            (3.0, 0.004_431_8, 0.998_650_1),
        ] {
            let (d, b) = density_and_share(a);
            assert!((d - density).abs() < 2e-7 && (b - below).abs() < 2e-7, "at {a}: {d} {b}");
        }
    }
}
