//! Finds a tracked body near its prediction where alignment from the prediction failed.
//!
//! The print is modelled in seven attitudes around the predicted one, with more blur, and shifted
//! over the patch. Each position is rated by the part of the image that the print explains beyond
//! plain facets. The best positions are aligned. The model of an attitude is computed once and its
//! least squares are factored once, so a shift costs one product per pixel.

use nalgebra::{DMatrix, DVector, Isometry3, UnitQuaternion, Vector3};

use super::model::{FacetShares, Scene};
use super::patch::Patch;
use super::print::BodyPrint;
use super::samples::{self, Sample};
use super::state::State;

/// Rotation of a tried attitude from the prediction about one axis, radians.
const TURN_RAD: f64 = 0.14;
/// Samples of a model: more do not locate a blurred body better.
const SAMPLES: usize = 400;
/// Least samples of a model.
const MIN_SAMPLES: usize = 40;
/// Candidates kept of each attitude, and in all.
const MAX_CANDIDATES: usize = 3;
/// Ridge of the least squares, so that facets with hardly any samples have a solution too.
const RIDGE: f64 = 1e-3;
/// Steps between positions, relative to the extra blur.
const STEP_BLURS: f64 = 0.7;
/// One in this many samples may lie outside the patch or be saturated.
const MISSING_ONE_IN: usize = 20;

/// The most likely poses of a body within `reach_px` of its pose in `state`, best first.
pub(super) fn candidates(
    patch: &Patch,
    print: &BodyPrint,
    state: &State,
    reach_px: f64,
) -> Vec<Isometry3<f64>> {
    let mut found = Vec::new();
    for turn in attitudes() {
        let pose = &state.patch_from_markers;
        let turned = Isometry3::from_parts(pose.translation, turn * pose.rotation);
        let state = State { patch_from_markers: turned, ..state.clone() };
        if let Some(model) = BodyModel::new(patch, print, &state) {
            let step = (patch.extra_blur_px * STEP_BLURS).round().max(1.0) as isize;
            let most = (reach_px / step as f64) as isize;
            found.extend(model.candidates(patch, &state, step, most));
        }
    }
    keep_best(&mut found);
    found.into_iter().map(|(pose, _)| pose).collect()
}

/// Keeps the candidates with the largest explained part, best first.
fn keep_best(candidates: &mut Vec<(Isometry3<f64>, f64)>) {
    candidates.sort_by(|a, b| b.1.total_cmp(&a.1));
    candidates.truncate(MAX_CANDIDATES);
}

/// The predicted attitude, and one rotation either way about each axis.
fn attitudes() -> impl Iterator<Item = UnitQuaternion<f64>> {
    let about = |axis: Vector3<f64>| [axis, -axis].map(UnitQuaternion::from_scaled_axis);
    let axes = [Vector3::x(), Vector3::y(), Vector3::z()];
    std::iter::once(UnitQuaternion::identity())
        .chain(axes.into_iter().flat_map(move |axis| about(axis * TURN_RAD)))
}

/// A body modelled in one attitude.
struct BodyModel {
    samples: Vec<Sample>,
    /// White and black share of the facets that show in each sample.
    rows: Vec<FacetShares>,
    /// Normal matrix of white and black of each facet, factored.
    full: nalgebra::Cholesky<f64, nalgebra::Dyn>,
    /// Normal matrix of one radiance of each facet, factored.
    plain: nalgebra::Cholesky<f64, nalgebra::Dyn>,
    facets: usize,
}

impl BodyModel {
    fn new(patch: &Patch, print: &BodyPrint, state: &State) -> Option<Self> {
        let scene = Scene::new(print, state, patch);
        let all = samples::choose(patch, &scene);
        let samples: Vec<Sample> =
            all.iter().step_by((all.len() / SAMPLES).max(1)).copied().collect();
        if samples.len() < MIN_SAMPLES {
            return None;
        }
        let facets = print.facets.len();
        let mut full = DMatrix::identity(2 * facets, 2 * facets) * RIDGE;
        let mut plain = DMatrix::identity(facets, facets) * RIDGE;
        let mut rows = Vec::with_capacity(samples.len());
        for sample in &samples {
            let (row, count) = scene.shares(sample.facets(), &sample.direction(patch));
            for &(a, a_white, a_black) in &row[..count] {
                for &(b, b_white, b_black) in &row[..count] {
                    for (i, one) in [a_white, a_black].into_iter().enumerate() {
                        for (j, other) in [b_white, b_black].into_iter().enumerate() {
                            full[(2 * a + i, 2 * b + j)] += one * other;
                        }
                    }
                    plain[(a, b)] += (a_white + a_black) * (b_white + b_black);
                }
            }
            rows.push((row, count));
        }
        Some(Self { samples, rows, full: full.cholesky()?, plain: plain.cholesky()?, facets })
    }

    /// The best poses among shifts by up to `most` steps, at most [`MAX_CANDIDATES`], and the share
    /// of the radiance's variation that the print explains there beyond plain facets.
    fn candidates(
        &self,
        patch: &Patch,
        state: &State,
        step: isize,
        most: isize,
    ) -> Vec<(Isometry3<f64>, f64)> {
        let mut found = Vec::new();
        for down in -most..=most {
            for right in -most..=most {
                let (dx, dy) = (right * step, down * step);
                let Some(explained) = self.explained(patch, dx, dy) else { continue };
                let pose = &state.patch_from_markers;
                let position = pose.translation.vector;
                let shift =
                    Vector3::new(dx as f64, dy as f64, 0.0) * (position.z / patch.pinhole.focal_px);
                let moved = Isometry3::from_parts((position + shift).into(), pose.rotation);
                found.push((moved, explained));
            }
        }
        keep_best(&mut found);
        found
    }

    /// Part of the image that the shifted model explains beyond plain facets. `None` where much of
    /// it leaves the patch.
    fn explained(&self, patch: &Patch, dx: isize, dy: isize) -> Option<f64> {
        let mut full = DVector::zeros(2 * self.facets);
        let mut plain = DVector::zeros(self.facets);
        let (mut squared, mut missing) = (0.0, 0);
        for (sample, (row, count)) in self.samples.iter().zip(&self.rows) {
            let x = usize::from(sample.x).checked_add_signed(dx).filter(|x| *x < patch.width);
            let y = usize::from(sample.y).checked_add_signed(dy).filter(|y| *y < patch.height);
            let radiance = match (x, y) {
                (Some(x), Some(y)) => f64::from(patch.at(x, y)),
                _ => f64::NAN,
            };
            if radiance.is_nan() {
                missing += 1;
                continue;
            }
            squared += radiance * radiance;
            for &(facet, white, black) in &row[..*count] {
                full[2 * facet] += white * radiance;
                full[2 * facet + 1] += black * radiance;
                plain[facet] += (white + black) * radiance;
            }
        }
        // Missing pixels count as black, so only a few are allowed.
        if missing * MISSING_ONE_IN > self.samples.len() {
            return None;
        }
        let of_plain = plain.dot(&self.plain.solve(&plain));
        let of_full = full.dot(&self.full.solve(&full));
        let left = squared - of_plain;
        (left > 0.0).then(|| (of_full - of_plain) / left)
    }
}
