//! Normalises all profiles of a marker to one light.
//!
//! Where the edge of a shadow crosses a marker, white and black differ from profile to profile.
//! Each profile is compared with the print that it should show, which gives its own white and
//! black. With these it is scaled to the average of the marker.

use super::model::share;
use super::profile::{EdgeProfile, Side};
use crate::gaussian::Gaussian;

/// Least radiance of a profile's white above its black, as a share of the marker's mean. Below,
/// noise hides the edge.
const MIN_CONTRAST_SHARE: f64 = 0.05;

/// Least variance of the share of white over a profile's samples: with less, all of them are white,
/// or all black.
const MIN_SPREAD: f64 = 0.01;

/// Scales the samples of every profile to the mean white and the mean black of all. `blur` is that
/// of the first and third side, then of the second and fourth, pixels. Profiles without contrast
/// are removed.
pub(super) fn level(sides: &mut [Side; 4], blur: [f64; 2]) {
    let levels: Vec<Vec<Option<(f64, f64)>>> =
        sides.iter().enumerate().map(|(k, side)| levels_of(side, blur[k % 2])).collect();
    let known = || levels.iter().flatten().flatten();
    let count = known().count().max(1) as f64;
    let white = known().map(|(white, _)| white).sum::<f64>() / count;
    let black = known().map(|(_, black)| black).sum::<f64>() / count;
    for (side, levels) in sides.iter_mut().zip(levels) {
        let mut levels = levels.into_iter();
        side.profiles.retain_mut(|profile| {
            let Some((own_white, own_black)) = levels.next().flatten() else { return false };
            let contrast = own_white - own_black;
            for sample in &mut profile.samples {
                let share = (sample.radiance - own_black) / contrast;
                sample.radiance = black + (white - black) * share;
            }
            contrast > MIN_CONTRAST_SHARE * (white - black)
        });
    }
}

/// Whether any sample may be clipped. Where white saturates, a profile does not show its own white.
pub(super) fn is_clipped(sides: &[Side; 4]) -> bool {
    let mut samples =
        sides.iter().flat_map(|side| &side.profiles).flat_map(|profile| &profile.samples);
    samples.any(|sample| sample.is_clipped)
}

/// White and black, by least squares, of each profile of a side whose edge is about where it was
/// guessed. `None` where white is no brighter.
fn levels_of(side: &Side, blur: f64) -> Vec<Option<(f64, f64)>> {
    let gaussian = Gaussian::get();
    let of = |profile: &EdgeProfile| {
        let (mut n, mut x, mut xx, mut y, mut xy) = (0.0, 0.0, 0.0, 0.0, 0.0);
        // A clipped sample has a higher true radiance.
        for sample in profile.samples.iter().filter(|sample| !sample.is_clipped) {
            let white = share(gaussian, profile, sample.depth, 0.0, blur).white;
            n += 1.0;
            x += white;
            xx += white * white;
            y += sample.radiance;
            xy += white * sample.radiance;
        }
        let determinant = n * xx - x * x;
        let slope = (n * xy - x * y) / determinant;
        let black = (y - slope * x) / n;
        // False for a NaN.
        (determinant > MIN_SPREAD * n * n && slope > 0.0 && black.is_finite())
            .then_some((black + slope, black))
    };
    side.profiles.iter().map(of).collect()
}
