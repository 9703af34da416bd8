//! Aligns the whole body with the image.
//!
//! Corners use only the four edges of a marker. Alignment uses the whole print. It models the
//! radiance of the view's pixels for a pose of the body, blurred by lens and motion. Gauss-Newton
//! changes pose, blur and radiance of the facets until both match. It needs no decoded marker, only
//! a start that is off by about half a cell at most. The idea is that of DodecaPen (Wu et al., UIST
//! 2017), applied to bodies of flat facets. The model is in closed form, so no picture of the body
//! is rendered.
//!
//! | module | what it answers |
//! | --- | --- |
//! | `alignment` | options and results |
//! | `print` | what is printed on a body |
//! | `patch`, `pinhole` | what radiance the view shows around the body, and where its pixels look |
//! | `halves` | which halves of a stitched picture show the body, and where |
//! | `spread` | the point spread of a moving body, and its unknowns |
//! | `state` | the unknowns, their places in the normal equations, their priors |
//! | `model` | the radiance that each pixel should have (`geometry`: where a pixel sees a facet; `blurred`: a facet behind a Gaussian) |
//! | `samples` | which pixels are fitted |
//! | `robust` | weights, residual sigmas, residual correlation |
//! | `levels` | white and black level of each facet |
//! | `normal_equations`, `solve` | which pose explains the pixels best |
//! | `occlusion` | what is occluded by something in front of the body |
//! | `covariance` | how precise the pose is |
//! | `evidence` | how well the cells match the image |
//! | `acceptance` | whether that is enough: all decisions and their limits |
//! | `depiction` | the body's pixels beside those of its model, for people |
//!
//! Each module uses only modules above it in this order: pinhole, print, evidence and alignment
//! types, then halves, patch, spread, state, model, samples, then the rest, and `mod.rs` at last.

mod acceptance;
mod acquire;
mod alignment;
mod covariance;
mod depiction;
mod evidence;
mod halves;
mod levels;
mod model;
mod normal_equations;
mod occlusion;
mod patch;
mod pinhole;
mod print;
mod robust;
mod samples;
mod solve;
mod spread;
mod state;

pub use acceptance::{
    is_precise, is_precise_by_corners, least_log_odds_anywhere, least_log_odds_marked,
    least_log_odds_predicted,
};
pub use acquire::{Place, Templates};
pub use alignment::{
    AlignError, AlignOptions, Alignment, SeenResponse, SeenStitch, VIDEO_COVARIANCE_SCALE,
};
pub use depiction::{Depiction, depict};
pub use evidence::Evidence;
pub use patch::{Motion, Picture};
pub use print::{BodyPrint, MAX_CELLS, PrintError};

use flockeye_geometry::camera::Half;
use flockeye_geometry::pose::{PoseEstimate, turned_covariance};
use nalgebra::{Isometry3, Matrix2, Matrix6, Unit, Vector3};

use crate::light::LinearLight;
use evidence::compare;
use patch::Patch;
use samples::Sample;
use solve::BodyFit;
use state::{PosePrior, Prior, State};

/// The patch shows this much background beside the body, in standard deviations of blur.
const PATCH_MARGIN_BLURS: f64 = 4.0;
/// Time of the path that gives the direction of the motion, seconds.
const MOMENT_S: f64 = 1e-3;
/// Least motion with a direction, pixels of the patch in that time.
const MIN_MOTION_PX: f64 = 1e-3;
/// Extra blur of the coarse fit, cells of the smallest marker. With more the fit diverged, because
/// the background bleeds in.
const COARSE_BLUR_CELLS: f64 = 0.45;
const COARSE_ITERATIONS: usize = 6;
/// Least log odds of a body in each half of a stitched picture that shows the shift between them. Read
/// from a curve (docs/results/constants.md#stitched-cameras).
const HALF_LOG_ODDS: f64 = 2.0;
/// Angle by which the fits of a body in both halves of a picture, and in one, may differ if the camera
/// has one centre: a fraction of a pixel.
const ONE_CENTRE_RAD: f64 = 1e-3;
/// Deviation of the disparity between the halves of a stitched picture, in cells, from which on a fit
/// is tried from several: half a cell is what a fit finds back from.
const MISLEADING_CELLS: f64 = 0.4;
/// Side of a cell from which on a part of a body shows its print, pixels of the sphere image.
const LEAST_CELL_PX: f64 = 3.5;
/// Most fits without the parts that prove to be occluded.
const MAX_REFITS: usize = 2;
/// Standard deviation of the error that all edges share, pixels of the sphere image.
const COMMON_EDGE_SIGMA_PX: f64 = 0.012;
/// The covariance is multiplied by 1 + this times the square of the occluded share.
///
/// An occluder shows through the point spread along its rim, beyond the pixels that are left out.
/// That error grows with the occluded share. On simulated flights (seeds 1001 to 1150) NEES without
/// this factor was 5 with more than 40 % occluded, and 2.4 without occlusion. With it NEES is 2.4
/// to 3.4 everywhere.
const OCCLUSION_RIM: f64 = 3.0;

/// Aligns `print` with a picture, from the pose `start` (`camera_from_markers`).
///
/// [`Alignment::is_accepted`] and its siblings decide whether the result is the body.
///
/// # Errors
/// [`AlignError`]: no pixels to compare, or input that is not finite.
pub fn align(
    print: &BodyPrint,
    picture: &Picture<'_>,
    start: &Isometry3<f64>,
    options: &AlignOptions,
) -> Result<Alignment, AlignError> {
    let view = PreparedView::new(print, picture, start, options, 0.0)?;
    let state = view.state(print, start);
    if view.knows_halves(print, &state) {
        let found = view.align(print, state, &[], options)?;
        // A fit from one start may be wrong by a cell: it must not teach the camera's constants.
        let stitch = found.stitch.filter(|_| !view.may_mislead(print, &found));
        return Ok(Alignment { stitch, ..found });
    }
    let mut others = view.other_constants(&state);
    // The camera may also have one centre. Then no pixel is mixed, and both halves are one picture.
    let of_one_centre = Picture { stitch: None, ..*picture };
    let one_centre = PreparedView::new(print, &of_one_centre, start, options, 0.0)?;
    let one = one_centre.align(print, one_centre.state(print, start), &[], options).ok();
    others.extend(one.iter().map(|one| view.state(print, &one.camera_from_markers)));
    let two = view.align(print, state, &others, options);
    match one {
        Some(one) if two.as_ref().map_or(true, |two| is_one_centre(two, &one)) => {
            Ok(Alignment { stitch: two.ok().and_then(|two| two.stitch), ..one })
        }
        _ => two,
    }
}

/// Whether a body that was fitted in `two` halves of a stitched picture is where the fit of `one`
/// picture has it, and the halves have no more evidence for themselves.
fn is_one_centre(two: &Alignment, one: &Alignment) -> bool {
    let place = one.camera_from_markers.translation.vector;
    let apart = two.camera_from_markers.translation.vector - place;
    apart.norm() < ONE_CENTRE_RAD * place.norm() && one.evidence.log_odds >= two.evidence.log_odds
}

/// Start poses (`camera_from_markers`) for alignment of `print` at a `place`, in any attitude: the
/// likeliest of each kind of template first. `templates` belong to the print.
///
/// They are rough, so they need [`AlignOptions::coarse_first`]. The list is empty where the picture
/// does not show the place.
pub fn starts_at(
    print: &BodyPrint,
    templates: &Templates,
    picture: &Picture<'_>,
    place: &Place,
    options: &AlignOptions,
) -> Vec<Isometry3<f64>> {
    let Place { direction_in_camera, range_m } = *place;
    let middle = direction_in_camera * range_m;
    let start = Isometry3::translation(middle.x, middle.y, middle.z);
    let margin_rad = print.radius_m() / range_m;
    let Ok(view) = PreparedView::new(print, picture, &start, options, margin_rad) else {
        return Vec::new();
    };
    let PreparedView { patch, prior, .. } = view;
    let middle = patch.view_from_camera * direction_in_camera;
    let lens_px = prior.spread.gaussian[(0, 0)].sqrt();
    let camera_from_patch = patch.view_from_camera.inverse();
    let starts = acquire::starts(templates, &patch, &middle, range_m, lens_px);
    let place = direction_in_camera * range_m;
    let camera_from_shown = picture.stitch.map_or(Isometry3::identity(), |stitch| {
        stitch.shown_from_camera(Half::of(&place), &place).inverse()
    });
    starts.into_iter().map(|start| camera_from_shown * (camera_from_patch * start)).collect()
}

fn is_valid(start: &Isometry3<f64>, picture: &Picture<'_>) -> bool {
    start.translation.vector.iter().all(|x| x.is_finite())
        && (start.rotation.quaternion().norm() - 1.0).abs() < 1e-6
        && (picture.view.camera_from_view.quaternion().norm() - 1.0).abs() < 1e-6
        && (1.0..1e6).contains(&picture.view.focal_px)
        && (1.0..1e6).contains(&picture.pixels_per_radian)
}

/// Width of the blur beside a facet, pixels.
fn blur_margin_px(blur: &Matrix2<f64>) -> f64 {
    PATCH_MARGIN_BLURS * blur.diagonal().max().max(0.0).sqrt()
}

/// The part of a view that shows a body, and the expected blur.
struct PreparedView<'p> {
    patch: Patch,
    prior: Prior,
    light: &'p LinearLight,
}

impl<'p> PreparedView<'p> {
    /// The part of `picture` that shows a body at `start`, and `margin_rad` around it.
    fn new(
        print: &BodyPrint,
        picture: &Picture<'p>,
        start: &Isometry3<f64>,
        options: &AlignOptions,
        margin_rad: f64,
    ) -> Result<Self, AlignError> {
        if !is_valid(start, picture) {
            return Err(AlignError::NotInView);
        }
        let Motion { rate_in_camera, exposure_s } = picture.motion;
        let path_rad = rate_in_camera * exposure_s;
        let lens_rad = options.blur_px / picture.pixels_per_radian;
        let beside_rad = PATCH_MARGIN_BLURS * lens_rad.hypot(path_rad.norm() / 12f64.sqrt());
        let place = start.translation.vector;
        let moved_rad = picture.stitch.map_or(0.0, |stitch| stitch.extent_rad(&place).0);
        let margin_rad = margin_rad + beside_rad + moved_rad;
        let patch = Patch::cut(picture, start, print.radius_m(), margin_rad, options.max_body_px)
            .ok_or(AlignError::NotInView)?;
        let magnification = patch.pinhole.focal_px / picture.pixels_per_radian;
        let blur_px = options.blur_px * magnification;
        // Averaging blocks and interpolating the view add a little blur.
        let blur_px = (blur_px.powi(2) + 1.0 / 12.0).sqrt();
        let sight = start.translation.vector.normalize();
        let seen_px = |along: Vector3<f64>| {
            let there = patch.view_from_camera * (sight + along);
            patch.pinhole.project(&there).unwrap_or(patch.pinhole.centre_px)
        };
        let motion = seen_px(rate_in_camera * MOMENT_S) - seen_px(Vector3::zeros());
        let motion = Unit::try_new(motion, MIN_MOTION_PX);
        let path_px = seen_px(path_rad) - seen_px(Vector3::zeros());
        // The result's covariance is multiplied by these, so the prior counts as much more.
        let scale = options.covariance_scale * options.coding_covariance_scale;
        let pose = options.predicted.and_then(|predicted| {
            let covariance = predicted.covariance + patch.halves.of_predictions();
            let predicted = PoseEstimate { covariance, ..predicted };
            PosePrior::new(&patch.view_from_camera, &predicted, scale)
        });
        let response_sigma = picture.response_sigma;
        let usual = Prior::new(blur_px, path_px, motion, magnification);
        let constants = patch.halves.prior().and_then(|covariance| covariance.try_inverse());
        let prior = Prior { pose, response_sigma, constants, ..usual };
        Ok(Self { patch, prior, light: picture.light })
    }

    /// The state to start from at a pose in the camera frame.
    fn state(&self, print: &BodyPrint, camera_from_markers: &Isometry3<f64>) -> State {
        let patch_from_markers = self.patch.view_from_camera * camera_from_markers;
        State::new(print, patch_from_markers, &self.prior)
    }

    /// Side of the smallest marker's cells in the patch, pixels, with the markers at this pose in
    /// the camera's or the patch's frame.
    fn cell_px(&self, print: &BodyPrint, pose: &Isometry3<f64>) -> f64 {
        let range_m = pose.translation.vector.norm();
        print.smallest_cell_m() / range_m * self.patch.pinhole.focal_px
    }

    fn align(
        &self,
        print: &BodyPrint,
        start: State,
        others: &[State],
        options: &AlignOptions,
    ) -> Result<Alignment, AlignError> {
        let Self { patch, prior, .. } = self;
        let first = if options.coarse_first { self.coarse(print, start) } else { start };
        let others = others.iter().map(|other| self.coarse(print, other.clone()));
        let mut best: Result<(BodyFit, Evidence), AlignError> = Err(AlignError::Nothing);
        for start in [first].into_iter().chain(others) {
            let tried = self.fit_visible(print, start, options.max_iterations);
            let log_odds = |tried: &Result<(BodyFit, Evidence), AlignError>| {
                tried.as_ref().map_or(f64::NEG_INFINITY, |(_, evidence)| evidence.log_odds)
            };
            if best.is_err() || log_odds(&tried) > log_odds(&best) {
                best = tried;
            }
        }
        let (fit, evidence) = best?;
        let along_sight = self.common_error(print, &fit.patch_from_markers);
        let rim = 1.0 + OCCLUSION_RIM * (1.0 - fit.visible_share).powi(2);
        let scale = rim * options.covariance_scale;
        let shown = fit.covariance * scale + along_sight;
        let coded = fit.covariance * (scale * options.coding_covariance_scale) + along_sight;
        let camera_from_patch = patch.view_from_camera.inverse();
        let camera_from_markers = camera_from_patch * fit.patch_from_markers;
        let mixed = patch.halves.mixed_covariance(&camera_from_markers.translation.vector);
        Ok(Alignment {
            camera_from_markers,
            covariance: turned_covariance(&camera_from_patch, &coded) + mixed,
            is_precise: is_precise(&shown),
            stretch_px2: prior.stretch_px2(&fit.state.spread),
            evidence,
            visible_share: fit.visible_share,
            response: fit.bend.and_then(|seen| seen.response(self.light)),
            stitch: fit.stitch.filter(|_| self.both_halves_show_print(print, &fit)),
        })
    }

    /// Whether each half of a stitched picture shows cells of the body, so that their shift against
    /// each other is that of the lenses.
    fn both_halves_show_print(&self, print: &BodyPrint, fit: &BodyFit) -> bool {
        let shows = |half: u8| {
            let own: Vec<Sample> =
                fit.samples.iter().filter(|sample| sample.half == half).copied().collect();
            let per_pixel = self.prior.samples_per_pixel();
            compare(&self.patch, print, &fit.state, &own, per_pixel).0.log_odds > HALF_LOG_ODDS
        };
        (0..).take(self.patch.halves.count()).all(shows)
    }

    /// Whether a fit needs no other starts: the disparity between the halves is known so well that the
    /// print cannot mislead it, or one half shows so little that nothing could be learned.
    fn knows_halves(&self, print: &BodyPrint, start: &State) -> bool {
        let cell_px = self.cell_px(print, &start.patch_from_markers);
        !self.patch.halves.show_both_sides(print.radius_m())
            || cell_px < LEAST_CELL_PX * self.prior.magnification
            || self.deviation_px() < MISLEADING_CELLS * cell_px
    }

    /// Whether the print could mislead a fit to another disparity.
    fn may_mislead(&self, print: &BodyPrint, found: &Alignment) -> bool {
        let cell_px = self.cell_px(print, &found.camera_from_markers);
        self.deviation_px() >= MISLEADING_CELLS * cell_px
    }

    /// Deviation of the disparity between the halves, pixels of the patch.
    fn deviation_px(&self) -> f64 {
        self.patch.halves.most_uncertain().1 * self.patch.pinhole.focal_px
    }

    /// Other starts for uncertain constants of a stitched camera: half a deviation and one to either side. A track
    /// has followed one of the halves, so one of them shows the body where it does in `start`.
    fn other_constants(&self, start: &State) -> Vec<State> {
        let halves = &self.patch.halves;
        let (deviation, _) = halves.most_uncertain();
        let other = |half: Half, share: f64| {
            let constants = deviation * share;
            let pose = halves.shown_alike(half, &start.patch_from_markers, &constants);
            State { patch_from_markers: pose, constants, ..start.clone() }
        };
        let of_half = |half: Half| [0.5, -0.5, 1.0, -1.0].map(|share| other(half, share));
        Half::ALL.into_iter().flat_map(of_half).collect()
    }

    /// The state after a fit to the patch with more blur; `start` where that fails.
    fn coarse(&self, print: &BodyPrint, start: State) -> State {
        let extra_blur_px = COARSE_BLUR_CELLS * self.cell_px(print, &start.patch_from_markers);
        if !extra_blur_px.is_finite() {
            return start;
        }
        let blurred = self.patch.blurred(extra_blur_px);
        match solve::fit(&blurred, print, start.clone(), &[], &self.prior, COARSE_ITERATIONS) {
            Some(fit) => State { spread: start.spread, ..fit.state },
            None => start,
        }
    }

    /// Fits the body, then again without the occluded facets. An arm in front of a facet is dark,
    /// and makes the body appear nearer.
    fn fit_visible(
        &self,
        print: &BodyPrint,
        state: State,
        max_iterations: usize,
    ) -> Result<(BodyFit, Evidence), AlignError> {
        let Self { patch, prior, .. } = self;
        let compare = |state: &State, samples: &[Sample]| {
            compare(patch, print, state, samples, prior.samples_per_pixel())
        };
        let fit_without = |state, left_out: &[bool]| {
            solve::fit(patch, print, state, left_out, prior, max_iterations)
        };
        let mut fit = fit_without(state, &[]).ok_or(AlignError::Nothing)?;
        let (mut evidence, mut disagrees) = compare(&fit.state, &fit.samples);
        let mut left_out = vec![false; print.facets.len()];
        for _ in 0..MAX_REFITS {
            let agreeing = evidence.agreeing_facets;
            let Some(occluded) = occlusion::occluded_facets(print, agreeing, &disagrees) else {
                break;
            };
            for (out, occluded) in left_out.iter_mut().zip(occluded) {
                *out |= occluded;
            }
            let Some(refit) = fit_without(fit.state.clone(), &left_out) else { break };
            (evidence, disagrees) = compare(&refit.state, &refit.samples);
            fit = refit;
        }
        if !fit.is_whole {
            // The evidence counts the occluded parts, too.
            (evidence, _) = compare(&fit.state, &solve::all_samples(patch, print, &fit.state));
        }
        Ok((fit, evidence))
    }

    /// Covariance of an error that all edges share and no residual shows. Black grows or shrinks by
    /// some hundredths of a pixel, which moves the body along the line of sight. Causes are the
    /// camera's response, the shape of the point spread, and occlusions that were not found.
    fn common_error(&self, print: &BodyPrint, patch_from_markers: &Isometry3<f64>) -> Matrix6<f64> {
        let position = patch_from_markers.translation.vector;
        let sphere_px = self.patch.pinhole.focal_px / self.prior.magnification;
        // A body of radius R at range r covers f R/r pixels: an edge error e costs e r^2/(f R).
        let range_sigma_m =
            position.norm_squared() * COMMON_EDGE_SIGMA_PX / (sphere_px * print.radius_m());
        let along = position.normalize() * range_sigma_m;
        let mut covariance = Matrix6::zeros();
        covariance.fixed_view_mut::<3, 3>(0, 0).copy_from(&(along * along.transpose()));
        covariance
    }
}

#[cfg(test)]
mod tests;
