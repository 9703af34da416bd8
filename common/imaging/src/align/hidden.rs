//! What of a body is hidden by something before it: an arm, a propeller, the own airframe.
//!
//! What is before the body is mostly darker than paper, and its soft edge pulls every edge next to
//! it: millimetres at 2 m, where alignment is good to a tenth of that. No robust weight sees that
//! edge, since a pixel a little too dark is no outlier. So pixels that are far off what is modelled
//! are left out together with all that the point spread mixes with them, and facets whose cells do not
//! agree although their outliers are gone are left out as a whole.

use super::levels::reference_scale;
use super::patch::Patch;
use super::samples::Sample;
use super::unknowns::State;

/// A pixel is hidden if it is off by more than so many deviations of the noise, and by this share of
/// the light of the facet's white: edges of a pose that is not yet right are off by less.
const NOISE_DEVIATIONS: f64 = 5.0;
const SHARE_OF_WHITE: f64 = 0.12;
/// Where less than this share of a body is left, what was taken for it is something else.
pub(super) const LEAST_SEEN: f64 = 0.25;
/// What it hides reaches so far, deviations of the point spread.
const REACH: f64 = 2.5;

/// What is left out of a fit.
#[derive(Debug, Default)]
pub(super) struct Hidden {
    /// Of the patch's pixels; empty: none.
    pixels: Vec<bool>,
    width: usize,
    /// Of the body's facets; empty: none.
    facets: Vec<bool>,
    /// See [`Hidden::share_seen`].
    share_seen: Option<f64>,
}

impl Hidden {
    /// Nothing but these facets.
    pub fn of_facets(facets: &[bool]) -> Self {
        Self { facets: facets.to_vec(), ..Self::default() }
    }

    /// The pixels too that are off by such `residuals` from what is modelled at `state`, and those next
    /// to them; unless that is most of them, which only says that the body is not there.
    pub fn add_pixels(
        &mut self,
        patch: &Patch,
        state: &State,
        scales: &[f64],
        samples: &[Sample],
        residuals: &[f32],
    ) {
        let noise = NOISE_DEVIATIONS * reference_scale(scales, samples);
        let reach_px = REACH * (state.blur.trace().max(0.0) / 2.0).sqrt();
        let reach = reach_px.ceil().min(patch.width as f64) as isize;
        self.width = patch.width;
        self.pixels = vec![false; patch.width * patch.height];
        for (sample, &residual) in samples.iter().zip(residuals) {
            let [white, _] = state.levels[usize::from(sample.facet)];
            if f64::from(residual).abs() > noise.max(SHARE_OF_WHITE * white) {
                mark_disc(&mut self.pixels, patch, sample, reach);
            }
        }
        let seen = samples.iter().filter(|sample| !self.has_pixel(sample)).count();
        let share_seen = seen as f64 / samples.len().max(1) as f64;
        self.share_seen = Some(share_seen);
        if seen == samples.len() || share_seen < LEAST_SEEN {
            self.pixels.clear();
        }
    }

    /// The share of the pixels that nothing was found to be before; all of them before it was asked.
    pub fn share_seen(&self) -> f64 {
        self.share_seen.unwrap_or(1.0)
    }

    /// Whether it hides any pixel by itself.
    pub fn has_pixels(&self) -> bool {
        !self.pixels.is_empty()
    }

    /// Whether it hides nothing.
    pub fn is_empty(&self) -> bool {
        self.pixels.is_empty() && self.facets.is_empty()
    }

    #[inline]
    fn has_pixel(&self, sample: &Sample) -> bool {
        let (x, y) = (usize::from(sample.x), usize::from(sample.y));
        self.pixels.get(y * self.width + x).is_some_and(|&is_hidden| is_hidden)
    }

    /// The same, or because it shows such a facet.
    #[inline]
    pub fn holds(&self, sample: &Sample) -> bool {
        self.has_pixel(sample)
            || (!self.facets.is_empty() && sample.facets().any(|facet| self.facets[facet]))
    }
}

fn mark_disc(pixels: &mut [bool], patch: &Patch, sample: &Sample, reach: isize) {
    let (x, y) = (sample.x as isize, sample.y as isize);
    let rows = (y - reach).max(0)..=(y + reach).min(patch.height as isize - 1);
    for row in rows {
        let half = f64::from((reach * reach - (row - y).pow(2)) as i32).sqrt() as isize;
        let first = (x - half).max(0) as usize;
        let last = (x + half).min(patch.width as isize - 1) as usize;
        let start = row as usize * patch.width;
        pixels[start + first..=start + last].fill(true);
    }
}
