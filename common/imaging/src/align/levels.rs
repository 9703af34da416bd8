//! The light of facets and its noise, with the pose as it is.

use nalgebra::{DMatrix, DVector};

use super::patch::Patch;
use super::samples::Sample;
use super::solve::Scene;
use super::unknowns::{BLACK_SHARE, COMMON, Layout, State};

/// No sensor's light is known better than this, of nominal white.
const FINEST_NOISE: f64 = 1.5e-3;
/// Light differs from facet to facet, and its noise with it, but not by more than this: a facet whose
/// residuals are larger is partly hidden, and its noise must not pass for that.
const NOISIEST: f64 = 3.0;
/// Two numbers for each facet need no more samples than about this.
const LEVEL_SAMPLES: usize = 1500;

/// A sample's facets, by their places, with the white and the black of each, and how many there are.
pub(super) type Row = ([(usize, f64, f64); 3], usize);

/// The levels that explain the samples best with everything else as it is; returns what is left
/// over on each facet.
pub(super) fn fit_levels(
    patch: &Patch,
    scene: &Scene<'_>,
    samples: &[Sample],
    layout: &Layout,
    state: &mut State,
) -> Option<Vec<f64>> {
    let count = layout.facets().count();
    let slot = |facet: usize| layout.level(facet).map(|at| (at - COMMON) / 2);
    let mut normal = DMatrix::<f64>::zeros(2 * count, 2 * count);
    let mut right = DVector::<f64>::zeros(2 * count);
    let step = (samples.len() / LEVEL_SAMPLES).max(1);
    let samples: Vec<Sample> = samples.iter().step_by(step).copied().collect();
    let samples = samples.as_slice();
    let mut rows: Vec<Row> = Vec::with_capacity(samples.len());
    // Without what shows beside the body.
    let mut lights = Vec::with_capacity(samples.len());
    for sample in samples {
        let mut row = [(0, 0.0, 0.0); 3];
        let mut used = 0;
        let direction = sample.direction(patch);
        for index in sample.facets() {
            let (Some((seen, blurred)), Some(slot)) = (scene.facet(index), slot(index)) else {
                continue;
            };
            let at = seen.seen(&direction);
            let black = f64::from(blurred.black(at).value);
            let white = f64::from(blurred.coverage(at).value) - black;
            row[used] = (slot, white, black);
            used += 1;
        }
        let covered: f64 = row[..used].iter().map(|(_, white, black)| white + black).sum();
        let light = f64::from(sample.light) - f64::from(sample.behind) * (1.0 - covered);
        for &(slot, white, black) in &row[..used] {
            right[2 * slot] += white * light;
            right[2 * slot + 1] += black * light;
            for &(other, other_white, other_black) in &row[..used] {
                normal[(2 * slot, 2 * other)] += white * other_white;
                normal[(2 * slot, 2 * other + 1)] += white * other_black;
                normal[(2 * slot + 1, 2 * other)] += black * other_white;
                normal[(2 * slot + 1, 2 * other + 1)] += black * other_black;
            }
        }
        rows.push((row, used));
        lights.push(light);
    }
    let mean =
        samples.iter().map(|sample| f64::from(sample.light)).sum::<f64>() / samples.len() as f64;
    for slot in 0..count {
        // A facet without black cells, or hardly seen, has the mean's levels.
        for (k, level) in [(0, mean), (1, BLACK_SHARE.0 * mean)] {
            normal[(2 * slot + k, 2 * slot + k)] += 1e-3;
            right[2 * slot + k] += 1e-3 * level;
        }
    }
    let levels = normal.cholesky()?.solve(&right);
    let mut residuals = Vec::with_capacity(samples.len());
    for (light, (row, used)) in lights.iter().zip(&rows) {
        let model: f64 = row[..*used]
            .iter()
            .map(|&(slot, white, black)| white * levels[2 * slot] + black * levels[2 * slot + 1])
            .sum();
        residuals.push((light - model) as f32);
    }
    for (facet, at) in layout.facets() {
        state.levels[facet] = [levels[at - COMMON], levels[at - COMMON + 1]];
    }
    Some(facet_scales(samples, &residuals, state.levels.len()))
}

/// A robust standard deviation of each facet's residuals.
pub(super) fn facet_scales(samples: &[Sample], residuals: &[f32], facets: usize) -> Vec<f64> {
    let mut by_facet: Vec<Vec<f32>> = vec![Vec::new(); facets];
    for (sample, residual) in samples.iter().zip(residuals) {
        by_facet[usize::from(sample.facet)].push(residual.abs());
    }
    let all_scale = {
        let mut all: Vec<f32> = residuals.iter().map(|residual| residual.abs()).collect();
        deviation(&mut all)
    };
    let mut scales: Vec<f64> = by_facet
        .iter_mut()
        .map(|own| if own.len() < 20 { all_scale } else { deviation(own) })
        .map(|scale| scale.max(FINEST_NOISE))
        .collect();
    let most = NOISIEST * reference_scale(&scales, samples);
    for scale in &mut scales {
        *scale = scale.min(most);
    }
    scales
}

/// The scale that facets have which nothing hides: a quarter of the samples lie on facets with less.
pub(super) fn reference_scale(scales: &[f64], samples: &[Sample]) -> f64 {
    let mut counts = vec![0usize; scales.len()];
    for sample in samples {
        counts[usize::from(sample.facet)] += 1;
    }
    let mut facets: Vec<(f64, usize)> = scales.iter().copied().zip(counts).collect();
    facets.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut below = 0;
    for (scale, count) in facets {
        below += count;
        if 4 * below > samples.len() {
            return scale;
        }
    }
    FINEST_NOISE
}

/// Standard deviation of normal noise with this median of its size.
fn deviation(sizes: &mut [f32]) -> f64 {
    if sizes.is_empty() {
        return 0.0;
    }
    let middle = sizes.len() / 2;
    f64::from(*sizes.select_nth_unstable_by(middle, f32::total_cmp).1) / 0.674_5
}
