//! Parts of a body that something in front of it occludes: an arm, a propeller, the own airframe.
//!
//! An occluder is mostly darker than paper, and its soft edge moves every edge next to it. At 2 m
//! it moves them by millimetres, where alignment is good to a tenth of that. Robust weights do not
//! help, because a pixel that is a little too dark is no outlier. So occluded parts are left out:
//!
//! - Pixels with large residuals are left out, with all pixels that the point spread or the path
//!   mixes with them.
//! - Facets whose cells do not match the image are left out as a whole ([`occluded_facets`]).

use nalgebra::Vector2;

use super::patch::Patch;
use super::print::{BodyPrint, PrintedFacet};
use super::robust::reference_sigma;
use super::samples::Sample;
use super::spread::Spread;
use super::state::State;
use crate::occluded::{least_residual, mark_disc, reach_px};

/// Parts that a fit leaves out.
#[derive(Debug)]
pub(super) struct Occlusion {
    /// Whether each pixel of the patch is left out; empty if none is.
    pixels: Vec<bool>,
    width: usize,
    /// Whether each facet of the body is left out; empty if none is.
    facets: Vec<bool>,
    /// The share of the samples that are not occluded; 1 before [`Occlusion::add_pixels`].
    pub visible_share: f64,
}

impl Occlusion {
    /// An occlusion of these facets, and of no pixels.
    pub(super) fn of_facets(facets: &[bool]) -> Self {
        Self { pixels: Vec::new(), width: 0, facets: facets.to_vec(), visible_share: 1.0 }
    }

    /// Adds the pixels with large `residuals` at `state`, those next to them and along the path.
    pub(super) fn add_pixels(
        &mut self,
        patch: &Patch,
        state: &State,
        sigmas: &[f64],
        samples: &[Sample],
        residuals: &[Option<f32>],
    ) {
        let noise = reference_sigma(sigmas, samples);
        let reach_px = reach_px((state.spread.gaussian.trace().max(0.0) / 2.0).sqrt());
        let reach = reach_px.min(patch.width as f64) as usize;
        // Most occluders are arms of the same drone, so their edges are blurred along the same path.
        let Spread { path_px, .. } = state.spread;
        let steps = (2.0 * path_px.norm() / reach_px.max(1.0)).ceil().min(patch.width as f64);
        let share = |step| f64::from(step) / steps.max(1.0) - 0.5;
        let beside: Vec<_> = match state.spread.has_path() {
            true => (0..=steps as u16).map(|step| path_px * share(step)).collect(),
            false => vec![Vector2::zeros()],
        };
        self.width = patch.width;
        self.pixels = vec![false; patch.width * patch.height];
        for (sample, &residual) in samples.iter().zip(residuals) {
            let [white, _] = state.levels[usize::from(sample.facet)];
            let size = residual.map_or(0.0, |residual| f64::from(residual).abs());
            if size > least_residual(noise, white) {
                for along in &beside {
                    let [x, y] = [f64::from(sample.x) + along.x, f64::from(sample.y) + along.y];
                    mark_disc(&mut self.pixels, patch.width, (x as isize, y as isize), reach);
                }
            }
        }
        let visible = samples.iter().filter(|sample| !self.has_pixel(sample)).count();
        self.visible_share = visible as f64 / samples.len().max(1) as f64;
        if visible == samples.len() {
            self.pixels.clear();
        }
    }

    /// Whether any single pixels are left out.
    pub(super) fn has_pixels(&self) -> bool {
        !self.pixels.is_empty()
    }

    /// Whether nothing is left out.
    pub(super) fn is_empty(&self) -> bool {
        self.pixels.is_empty() && self.facets.is_empty()
    }

    #[inline]
    fn has_pixel(&self, sample: &Sample) -> bool {
        let (x, y) = (usize::from(sample.x), usize::from(sample.y));
        self.pixels.get(y * self.width + x).is_some_and(|&is_occluded| is_occluded)
    }

    /// Whether a sample is left out, as a pixel or because it shows an occluded facet.
    #[inline]
    pub(super) fn contains(&self, sample: &Sample) -> bool {
        self.has_pixel(sample)
            || (!self.facets.is_empty() && sample.facets().any(|facet| self.facets[facet]))
    }
}

/// The facets whose cells do not match the image ([`super::evidence::compare`]), and blank facets
/// next to them.
///
/// `None` if no facet is occluded, or if none matches: then the body may not be there.
pub(super) fn occluded_facets(
    print: &BodyPrint,
    agreeing_facets: u32,
    disagrees: &[bool],
) -> Option<Vec<bool>> {
    let is_occluded = |(index, facet): (usize, &PrintedFacet)| {
        let mut beside = facet.neighbours.iter().flatten();
        disagrees[index]
            || (facet.cells.is_none() && beside.any(|&(neighbour, _)| disagrees[neighbour]))
    };
    let occluded: Vec<bool> = print.facets.iter().enumerate().map(is_occluded).collect();
    (agreeing_facets > 0 && occluded.contains(&true)).then_some(occluded)
}
