//! White and black levels of the facets, with the pose held fixed.

use nalgebra::{DMatrix, DVector};

use super::model::{FacetShares, Scene};
use super::patch::Patch;
use super::robust::facet_sigmas;
use super::samples::Sample;
use super::state::{BLACK_SHARE_PRIOR, COMMON, Layout, State};

/// Two numbers for each facet need no more samples than about this.
const MAX_SAMPLES: usize = 1500;

/// Finds the white and black levels that explain the samples best, by linear least squares, and puts
/// them in `state`. Returns the residual sigma of each facet.
pub(super) fn fit_levels(
    patch: &Patch,
    scene: &Scene<'_>,
    samples: &[Sample],
    layout: &Layout,
    state: &mut State,
) -> Option<Vec<f64>> {
    let count = layout.facets().count();
    // A facet has an index if it faces the camera, as the facets of `Scene::shares` do.
    let slot = |facet: usize| Some((layout.level(facet)? - COMMON) / 2);
    let mut normal = DMatrix::<f64>::zeros(2 * count, 2 * count);
    let mut right = DVector::<f64>::zeros(2 * count);
    let step = (samples.len() / MAX_SAMPLES).max(1);
    let samples: Vec<Sample> = samples.iter().step_by(step).copied().collect();
    let samples = samples.as_slice();
    let mut rows: Vec<FacetShares> = Vec::with_capacity(samples.len());
    // Radiance of each sample without the background's part.
    let mut radiances = Vec::with_capacity(samples.len());
    for sample in samples {
        let (mut row, used) = scene.shares(sample.facets(), &sample.direction(patch));
        for (facet, ..) in &mut row[..used] {
            *facet = slot(*facet)?;
        }
        let covered: f64 = row[..used].iter().map(|(_, white, black)| white + black).sum();
        let radiance = f64::from(sample.radiance) - f64::from(sample.background) * (1.0 - covered);
        for &(slot, white, black) in &row[..used] {
            right[2 * slot] += white * radiance;
            right[2 * slot + 1] += black * radiance;
            for &(other, other_white, other_black) in &row[..used] {
                normal[(2 * slot, 2 * other)] += white * other_white;
                normal[(2 * slot, 2 * other + 1)] += white * other_black;
                normal[(2 * slot + 1, 2 * other)] += black * other_white;
                normal[(2 * slot + 1, 2 * other + 1)] += black * other_black;
            }
        }
        rows.push((row, used));
        radiances.push(radiance);
    }
    let mean =
        samples.iter().map(|sample| f64::from(sample.radiance)).sum::<f64>() / samples.len() as f64;
    for slot in 0..count {
        // A weak prior: a facet without black cells, or hardly visible, takes the mean's levels.
        for (k, level) in [(0, mean), (1, BLACK_SHARE_PRIOR.0 * mean)] {
            normal[(2 * slot + k, 2 * slot + k)] += 1e-3;
            right[2 * slot + k] += 1e-3 * level;
        }
    }
    let levels = normal.cholesky()?.solve(&right);
    let mut residuals = Vec::with_capacity(samples.len());
    for (radiance, (row, used)) in radiances.iter().zip(&rows) {
        let model: f64 = row[..*used]
            .iter()
            .map(|&(slot, white, black)| white * levels[2 * slot] + black * levels[2 * slot + 1])
            .sum();
        residuals.push((radiance - model) as f32);
    }
    for (facet, at) in layout.facets() {
        state.levels[facet] = [levels[at - COMMON], levels[at - COMMON + 1]];
    }
    Some(facet_sigmas(samples, &residuals, state.levels.len()))
}
