//! The unit Gaussian, from a table.

use std::sync::LazyLock;

/// Beyond so many standard deviations there is nothing: the density is lowered by what it has
/// there, and stretched so that the distribution goes from 0 to 1. So neither has a step.
pub(super) const REACH: f32 = 3.6;
/// Steps of the table for each standard deviation: linear between them is right to 1e-5.
const STEPS: f32 = 128.0;
const HALF: usize = (REACH * STEPS) as usize + 2;

/// Density and distribution function, at -HALF to HALF steps.
static TABLE: LazyLock<Vec<[f32; 2]>> = LazyLock::new(|| {
    let at = |step: usize| (step as f64 - HALF as f64) / f64::from(STEPS);
    let end = f64::from(REACH);
    let (floor, tail) = crate::edges::gaussian(-end);
    let kept = 1.0 - 2.0 * tail - 2.0 * floor * end;
    (0..=2 * HALF)
        .map(|step| {
            let z = at(step).clamp(-end, end);
            let (density, below) = crate::edges::gaussian(z);
            let above_floor = below - tail - floor * (z + end);
            [((density - floor) / kept) as f32, (above_floor / kept) as f32]
        })
        .collect()
});

/// The table, looked up once for a whole run over samples.
#[derive(Clone, Copy)]
pub(super) struct Gaussian(&'static [[f32; 2]]);

impl Gaussian {
    pub(super) fn get() -> Self {
        Self(&TABLE)
    }

    /// Density and distribution function at `z`; beyond [`REACH`] they stay as they are there.
    #[inline]
    pub(super) fn at(&self, z: f32) -> (f32, f32) {
        // A NaN becomes the lower end.
        let place = (z.clamp(-REACH, REACH) + REACH) * STEPS + (HALF as f32 - REACH * STEPS);
        let index = place as usize;
        let share = place - index as f32;
        let ([d0, b0], [d1, b1]) = (self.0[index], self.0[index + 1]);
        (d0 + (d1 - d0) * share, b0 + (b1 - b0) * share)
    }
}
