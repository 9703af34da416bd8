//! White and black levels of the facets, with the pose held fixed.

use nalgebra::{DMatrix, DVector};

use super::model::{FacetShares, Scene};
use super::patch::Patch;
use super::robust::facet_sigmas;
use super::samples::Sample;
use super::state::{BLACK_SHARE_PRIOR, COMMON, Layout, State};

/// Enough samples for two numbers of each facet.
const MAX_SAMPLES: usize = 1500;

/// Share of a saturated pixel's radiance above which its model is consistent, so that the pixel is
/// not used.
const SATURATED_SHARE: f64 = 0.9;

/// Finds the white and black levels that explain the samples best, by linear least squares, and
/// puts them in `state`. Returns the residual sigma of each facet.
pub(super) fn fit_levels(
    patch: &Patch,
    scene: &Scene<'_>,
    samples: &[Sample],
    layout: &Layout,
    state: &mut State,
) -> Option<Vec<f64>> {
    let step = (samples.len() / MAX_SAMPLES).max(1);
    let samples: Vec<Sample> = samples.iter().step_by(step).copied().collect();
    let rows = Rows::new(patch, scene, &samples, layout)?;
    let mut levels = rows.levels(|_| true)?;
    if samples.iter().any(|sample| sample.is_saturated) {
        let modelled: Vec<f64> = (0..samples.len()).map(|k| rows.modelled(k, &levels)).collect();
        levels = rows.levels(|k| {
            let least = SATURATED_SHARE * rows.radiances[k];
            !samples[k].is_saturated || modelled[k] < least
        })?;
    }
    let residuals: Vec<Option<f32>> = (0..samples.len())
        .map(|k| {
            let residual = samples[k].counted(rows.radiances[k] - rows.modelled(k, &levels));
            residual.map(|residual| residual as f32)
        })
        .collect();
    for (facet, at) in layout.facets() {
        state.levels[facet] = [levels[at - COMMON], levels[at - COMMON + 1]];
    }
    Some(facet_sigmas(&samples, &residuals, state.levels.len()))
}

/// Share of each level in each sample.
struct Rows {
    shares: Vec<FacetShares>,
    /// Radiance of each sample without the background's part.
    radiances: Vec<f64>,
    /// Mean radiance of the samples.
    mean: f64,
    facets: usize,
}

impl Rows {
    fn new(patch: &Patch, scene: &Scene<'_>, samples: &[Sample], layout: &Layout) -> Option<Self> {
        // A facet has an index if it faces the camera, as the facets of `Scene::shares` do.
        let slot = |facet: usize| Some((layout.levels[facet]? - COMMON) / 2);
        let mut shares: Vec<FacetShares> = Vec::with_capacity(samples.len());
        let mut radiances = Vec::with_capacity(samples.len());
        for sample in samples {
            let (mut row, used) =
                scene.shares(usize::from(sample.half), sample.facets(), &sample.direction(patch));
            for (facet, ..) in &mut row[..used] {
                *facet = slot(*facet)?;
            }
            let covered: f64 = row[..used].iter().map(|(_, white, black)| white + black).sum();
            let background = f64::from(sample.background) * (1.0 - covered);
            shares.push((row, used));
            radiances.push(f64::from(sample.radiance) - background);
        }
        let sum: f64 = samples.iter().map(|sample| f64::from(sample.radiance)).sum();
        let (mean, facets) = (sum / samples.len() as f64, layout.facets().count());
        Some(Self { shares, radiances, mean, facets })
    }

    /// The levels that explain the samples of which `counts` is true.
    fn levels(&self, counts: impl Fn(usize) -> bool) -> Option<DVector<f64>> {
        let mut normal = DMatrix::<f64>::zeros(2 * self.facets, 2 * self.facets);
        let mut right = DVector::<f64>::zeros(2 * self.facets);
        for (k, (row, used)) in self.shares.iter().enumerate().filter(|(k, _)| counts(*k)) {
            let radiance = self.radiances[k];
            for &(slot, white, black) in &row[..*used] {
                right[2 * slot] += white * radiance;
                right[2 * slot + 1] += black * radiance;
                for &(other, other_white, other_black) in &row[..*used] {
                    normal[(2 * slot, 2 * other)] += white * other_white;
                    normal[(2 * slot, 2 * other + 1)] += white * other_black;
                    normal[(2 * slot + 1, 2 * other)] += black * other_white;
                    normal[(2 * slot + 1, 2 * other + 1)] += black * other_black;
                }
            }
        }
        for slot in 0..self.facets {
            // A weak prior for facets without black cells, or hardly visible: the mean's levels.
            for (k, level) in [(0, self.mean), (1, BLACK_SHARE_PRIOR.0 * self.mean)] {
                normal[(2 * slot + k, 2 * slot + k)] += 1e-3;
                right[2 * slot + k] += 1e-3 * level;
            }
        }
        Some(normal.cholesky()?.solve(&right))
    }

    /// Modelled radiance of a sample from the levels, without the background's part.
    fn modelled(&self, k: usize, levels: &DVector<f64>) -> f64 {
        let (row, used) = &self.shares[k];
        row[..*used]
            .iter()
            .map(|&(slot, white, black)| white * levels[2 * slot] + black * levels[2 * slot + 1])
            .sum()
    }
}
