//! Fits a body to a patch: Gauss-Newton over pose, blur, code blur, the white and black levels of
//! each facet and the radiance of the seams, all in one step.
//!
//! In the last step the radiance may also change along each facet. Lamps and windows are some
//! metres away, and arms and hulls shade. This gradient is not fitted earlier, because a
//! half-occluded facet would pass for one.
//!
//! Residuals are weighted by Cauchy's function with a residual sigma for each facet, so that a
//! propeller or a shadow on one facet does not affect the others.

use std::cell::LazyCell;

use nalgebra::{Cholesky, DMatrix, DVector, Dyn, Isometry3, Matrix5, Matrix6};

use super::alignment::{SeenResponse, SeenStitch};
use super::covariance::Dependence;
use super::levels::fit_levels;
use super::model::{Scene, rim_shift_px};
use super::normal_equations::SampleSet;
use super::occlusion::Occlusion;
use super::patch::Patch;
use super::print::BodyPrint;
use super::robust::facet_sigmas;
use super::samples::{self, Sample};
use super::state::{CONSTANTS, Layout, Prior, RESPONSE, State, add_priors, apply_step};
use crate::light::LinearLight;

/// Motion of the body's rim below which a step is the last, pixels: the next step would be a
/// fraction of it.
const CONVERGED_PX: f64 = 0.03;
/// Motion of the rim in a step, pixels, below which large residuals are occlusions, not an error of
/// the pose.
const NEAR_CONVERGED_PX: f64 = 0.3;
/// Motion of the rim since the samples were chosen, pixels, above which they are chosen again.
const RESAMPLE_SHIFT_PX: f64 = 0.5;
/// Number of first steps whose motion does not count as wandering. Every fit takes more, because
/// the blur settles later than the pose. A good start needs hardly more.
const STRAIGHT_STEPS: usize = 2;
/// Error of a response's gamma for each unit of bend, because no response is a parabola. A linear
/// camera that was taken for sRGB seemed to have a bend of -0.7, and its gamma was off by 0.3.
const PARABOLA_ERROR: f64 = 0.4;
/// Standard deviation of the gamma between bodies and places in the picture: light is not even, and
/// lenses are not Gaussian.
const BODY_SIGMA: f64 = 0.1;
/// Least number of samples of a fit.
const MIN_SAMPLES: usize = 60;

/// The result of a fit.
#[derive(Debug, Clone)]
pub(super) struct BodyFit {
    /// The state with uniform radiance on each facet.
    pub state: State,
    /// The pose with radiance gradients; that of `state` where these are not determined.
    pub patch_from_markers: Isometry3<f64>,
    /// Covariance of that pose in the patch's axes: position (m), then rotation vector (rad).
    pub covariance: Matrix6<f64>,
    /// The pixels that were fitted.
    pub samples: Vec<Sample>,
    /// Whether these are all pixels of the facets that face the camera, without an occlusion.
    pub is_whole: bool,
    /// Share of the samples without an occlusion.
    pub visible_share: f64,
    /// The camera's response as the print shows it. `None` where it shows nothing of it.
    pub bend: Option<SeenBend>,
    /// What the picture shows of a stitched camera, where both halves show the body.
    pub stitch: Option<SeenStitch>,
}

/// How much the camera's response differs from the assumed one, from the samples alone.
///
/// The apparent radiance is L + `bend` (L - b)(w - L)/(w - b) where the real one is L, and b and w are
/// black and white. With code values proportional to light that are taken for sRGB it is about -1.
#[derive(Debug, Clone, Copy)]
pub(super) struct SeenBend {
    pub bend: f64,
    pub variance: f64,
    /// Apparent radiance of black and of white.
    pub levels: [f64; 2],
}

impl SeenBend {
    /// The response that explains the bend, where `light` is the assumed one. `None` where none does.
    pub(super) fn response(&self, light: &LinearLight) -> Option<SeenResponse> {
        let gamma = |bend: f64| light.gamma_seen(self.levels, bend);
        let deviation = self.variance.sqrt();
        let by_noise = (gamma(self.bend + deviation)? - gamma(self.bend - deviation)?) / 2.0;
        let by_parabola = PARABOLA_ERROR * self.bend;
        let variance = by_noise.powi(2) + by_parabola.powi(2) + BODY_SIGMA.powi(2);
        Some(SeenResponse { gamma: gamma(self.bend)?, variance })
    }
}

/// Fits a body to a patch, from `start`, using the facets that face the camera.
///
/// Facets that are set in `occluded_facets` are left out (none if it is empty), and so are occluded
/// pixels. `None` where too little of the body is visible, or the fit does not converge.
pub(super) fn fit(
    patch: &Patch,
    print: &BodyPrint,
    start: State,
    occluded_facets: &[bool],
    prior: &Prior,
    max_iterations: usize,
) -> Option<BodyFit> {
    let mut state = start;
    let focal_px = patch.pinhole.focal_px;
    let mut occlusion = Occlusion::of_facets(occluded_facets);
    let mut has_occlusion = false;
    let mut set = choose(patch, print, &mut state, &occlusion, None)?;
    let mut wandered = 0.0;
    for iteration in 1.. {
        let SampleSet { samples, layout, sigmas, .. } = &set;
        let scene = Scene::new(print, &state, patch);
        let mut sums = set.sum(patch, &scene, &state);
        let from_samples = sums.normal.clone();
        add_priors(&mut sums.normal, &mut sums.right, &state, layout, prior);
        let dependence = LazyCell::new(|| Dependence::of(&set, patch, &sums.residuals));
        let uniform = ..layout.uniform_count;
        let mut guided = sums.normal.view_range(uniform, uniform).into_owned();
        let mut right = sums.right.rows_range(uniform).into_owned();
        if let Some(pose) = &prior.pose
            && let Some(weight) = dependence.weight()
        {
            pose.add(&mut guided, &mut right, &state.patch_from_markers, weight);
        }
        let normal = guided.cholesky()?;
        let step = normal.solve(&right);
        let before = state.clone();
        let moved = apply_step(&mut state, &step, layout, focal_px)?;
        let is_straight = iteration <= STRAIGHT_STEPS;
        if !is_straight {
            wandered += in_deviations(&step, &normal)?;
        }
        let is_converged = moved < CONVERGED_PX && !is_straight;
        let is_last = is_converged || iteration >= max_iterations;
        if has_occlusion && is_last {
            // The prediction has no part in the last step: the filter adds it.
            let measured = |unknowns: usize| {
                let unknowns = ..unknowns;
                let normal = sums.normal.view_range(unknowns, unknowns).into_owned().cholesky()?;
                let right = sums.right.rows_range(unknowns).into_owned();
                let step = normal.solve(&right);
                let mut state = before.clone();
                apply_step(&mut state, &step, layout, focal_px)?;
                let from_samples = from_samples.view_range(unknowns, unknowns).into_owned();
                let explained = step.dot(&right);
                let (factor, covariance) =
                    dependence.pose_covariance(&normal, &from_samples, explained, wandered)?;
                let bend = seen_bend(&state, samples, prior, &normal, factor);
                let stitch = seen_stitch(&state, patch, layout, prior, &normal, factor);
                Some((state.patch_from_markers, covariance, bend, stitch))
            };
            let (patch_from_markers, covariance, bend, stitch) =
                measured(layout.count).or_else(|| measured(layout.uniform_count))?;
            return Some(BodyFit {
                state,
                patch_from_markers,
                covariance,
                samples: set.samples,
                is_whole: occlusion.is_empty(),
                visible_share: occlusion.visible_share,
                bend,
                stitch,
            });
        }
        let sigmas = facet_sigmas(samples, &sums.residuals, sigmas.len());
        let shift_px =
            rim_shift_px(&set.chosen_at, &state.patch_from_markers, print.radius_m(), focal_px);
        let mut must_resample = shift_px > RESAMPLE_SHIFT_PX;
        let is_near = moved < NEAR_CONVERGED_PX || iteration + 2 >= max_iterations;
        let mut is_occluder_found = false;
        if is_near && !has_occlusion {
            has_occlusion = true;
            occlusion.add_pixels(patch, &state, &sigmas, samples, &sums.residuals);
            is_occluder_found = occlusion.has_pixels();
            must_resample |= is_occluder_found;
        }
        if must_resample {
            // Levels that were fitted with an occluder are fitted again without it.
            let before = (!is_occluder_found).then_some((&set.layout, sigmas));
            set = choose(patch, print, &mut state, &occlusion, before)?;
        } else {
            set.sigmas = sigmas;
        }
    }
    None
}

/// The response as the samples show it, without its prior. `factor` makes the inverse of the normal
/// matrix a covariance. `None` where samples say nothing of it.
fn seen_bend(
    state: &State,
    samples: &[Sample],
    prior: &Prior,
    normal: &Cholesky<f64, Dyn>,
    factor: f64,
) -> Option<SeenBend> {
    let mut unit = DVector::zeros(normal.l_dirty().nrows());
    unit[RESPONSE] = 1.0;
    let information = 1.0 / normal.solve(&unit)[RESPONSE];
    let of_samples = information - prior.response_precision();
    // The facet that most pixels show has the most certain levels.
    let mut shown = vec![0usize; state.levels.len()];
    samples.iter().for_each(|sample| shown[usize::from(sample.facet)] += 1);
    let most = (0..shown.len()).max_by_key(|&facet| shown[facet])?;
    let [white, black] = state.levels[most];
    let seen = SeenBend {
        bend: state.response * information / of_samples,
        variance: factor / of_samples,
        levels: [black, white],
    };
    (of_samples > 0.0 && seen.bend.is_finite() && white > black).then_some(seen)
}

/// The constants of a stitched camera as the samples show them, without their prior. `None` where one
/// half shows all of the body.
fn seen_stitch(
    state: &State,
    patch: &Patch,
    layout: &Layout,
    prior: &Prior,
    normal: &Cholesky<f64, Dyn>,
    factor: f64,
) -> Option<SeenStitch> {
    let at = layout.constants?;
    let mut columns = DMatrix::zeros(normal.l_dirty().nrows(), CONSTANTS);
    columns.fixed_view_mut::<CONSTANTS, CONSTANTS>(at, 0).fill_with_identity();
    let of_both = normal.solve(&columns);
    let covariance: Matrix5<f64> = of_both.fixed_view::<CONSTANTS, CONSTANTS>(at, 0).into();
    patch.halves.seen(&state.constants, &covariance, prior.samples_per_pixel(), factor)
}

/// Length of a step of the pose, the first six unknowns, in standard deviations by the normal
/// equations (Mahalanobis distance). `None` where they do not determine the pose.
fn in_deviations(step: &DVector<f64>, normal: &Cholesky<f64, Dyn>) -> Option<f64> {
    let of_pose = step.fixed_rows::<6>(0);
    let columns = normal.solve(&DMatrix::identity(step.len(), 6));
    let covariance: Matrix6<f64> = columns.fixed_view::<6, 6>(0, 0).into();
    Some(of_pose.dot(&covariance.cholesky()?.solve(&of_pose)).sqrt())
}

/// All pixels that [`samples::choose`] finds in a state, occluded or not.
pub(super) fn all_samples(patch: &Patch, print: &BodyPrint, state: &State) -> Vec<Sample> {
    samples::choose(patch, &Scene::new(print, state, patch))
}

/// Fits the white and black levels of the facets that face the camera, at the pose of `state`.
/// Returns the samples; `None` where they are too few.
pub(super) fn fit_levels_alone(
    patch: &Patch,
    print: &BodyPrint,
    state: &mut State,
) -> Option<Vec<Sample>> {
    Some(choose(patch, print, state, &Occlusion::of_facets(&[]), None)?.samples)
}

/// Chooses the samples at a state. White and black levels and residual sigmas are fitted to them,
/// unless all facets that face the camera have them in the layout `before`. `None` where the samples
/// are too few.
fn choose(
    patch: &Patch,
    print: &BodyPrint,
    state: &mut State,
    occlusion: &Occlusion,
    before: Option<(&Layout, Vec<f64>)>,
) -> Option<SampleSet> {
    let scene = Scene::new(print, state, patch);
    let mut samples = samples::choose(patch, &scene);
    samples.retain(|sample| !occlusion.contains(sample));
    if samples.len() < MIN_SAMPLES {
        return None;
    }
    let layout = layout(&scene, &samples);
    let is_known = |before: &Layout| {
        layout.facets().all(|(facet, _)| before.levels.get(facet).is_some_and(Option::is_some))
    };
    let sigmas = match before {
        Some((before, sigmas)) if is_known(before) => sigmas,
        _ => fit_levels(patch, &scene, &samples, &layout, state)?,
    };
    Some(SampleSet { samples, layout, sigmas, chosen_at: state.patch_from_markers })
}

/// Index of each unknown of the facets that face the camera and of the seams that `samples` show.
pub(super) fn layout(scene: &Scene<'_>, samples: &[Sample]) -> Layout {
    let is_visible = scene.halves[0].visible.iter().map(Option::is_some);
    let seams = samples.iter().flat_map(|sample| sample.seams(scene.print).map(|(_, seam)| seam));
    Layout::new(is_visible, scene.print.seams, seams, scene.halves.len() > 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_step_counts_in_deviations_of_the_pose_whatever_else_it_changes() {
        // The seventh unknown is bound to the first. So the first has a deviation of
        // 1 / sqrt(4 - 3² / 9) = 1 / sqrt(3).
        let mut normal = DMatrix::<f64>::identity(7, 7);
        (normal[(0, 0)], normal[(6, 6)]) = (4.0, 9.0);
        (normal[(0, 6)], normal[(6, 0)]) = (3.0, 3.0);
        let normal = normal.cholesky().expect("it is positive definite");
        let deviations = |step: [f64; 7]| in_deviations(&DVector::from_row_slice(&step), &normal);
        let along_first =
            deviations([2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 5.0]).expect("it is determined");
        assert!((along_first - 2.0 * 3f64.sqrt()).abs() < 1e-12, "{along_first}");
        let along_two = deviations([0.0, 3.0, 4.0, 0.0, 0.0, 0.0, 0.0]).expect("it is determined");
        assert!((along_two - 5.0).abs() < 1e-12, "{along_two}");
    }
}
