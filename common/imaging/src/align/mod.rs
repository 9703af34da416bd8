//! The whole body aligned with the image.
//!
//! Corners use a marker's four edges; everything else that is printed knows where it is too. Here
//! the body's print is drawn at a pose, blurred as the lens and motion blur it, and compared with
//! the light of the view's pixels; pose, blur and the light of each facet are changed until they
//! agree (Gauss-Newton, `solve`). It needs no decoded marker, only a start about half a cell near.
//! The idea is that of DodecaPen (Wu et al., UIST 2017), carried over to bodies of flat facets, and
//! to drawing in closed form (`blurred`): no picture of the body is ever made.
//!
//! | module | what it answers |
//! | --- | --- |
//! | `print` | what is printed on a body |
//! | `patch` | which light does the view show round it |
//! | `geometry` | where does a pixel see a facet, and how does that move with the pose |
//! | `blurred` | how light is a facet at a point, seen through a Gaussian |
//! | `samples` | which pixels count |
//! | `hidden` | which of them something else is before |
//! | `unknowns`, `levels`, `sums` | what is unknown, how light are facets, normal equations |
//! | `solve` | which pose explains the pixels best |
//! | `covariance` | how sure is it |
//! | `score` | is it that body at all |
//! | `reacquire` | where else may it be, when it is not where it was predicted |

mod blurred;
mod covariance;
mod geometry;
mod hidden;
mod levels;
mod patch;
mod print;
mod reacquire;
mod samples;
mod score;
mod solve;
mod sums;
mod unknowns;

pub use print::{BodyPrint, MAX_CELLS, PrintError};
pub use score::{SURE_FACETS, Score};

use flockeye_geometry::view::View;
use nalgebra::{Isometry3, Matrix2, Matrix6};

use crate::image::LumaImage;
use crate::light::LinearLight;
use hidden::LEAST_SEEN;
use patch::Patch;
use samples::Sample;
use score::Verdict;
use solve::{Fit, Settings};
use unknowns::State;

/// How a body is aligned, and when that is believed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AlignOptions {
    /// Deviation of the lens's point spread, pixels of the sphere image.
    pub blur_px: f64,
    /// Patch pixels across a body at most: what is nearer is looked at less finely.
    pub widest_px: f64,
    /// Gauss-Newton steps at most.
    pub iterations: usize,
    /// Whether a first fit with more blur goes before, for a start that may be half a cell off.
    pub coarse_first: bool,
    /// The covariance that the pixels admit is multiplied by this, for what they do not show:
    /// compression, calibration.
    pub covariance_scale: f64,
}

impl Default for AlignOptions {
    /// The covariance scale is that of pipeline.yaml (`fusion.covariance_scale`).
    fn default() -> Self {
        Self {
            blur_px: 0.9,
            widest_px: 75.0,
            iterations: 8,
            coarse_first: false,
            covariance_scale: 3.1,
        }
    }
}

/// A body found in a view.
#[derive(Debug, Clone, PartialEq)]
pub struct Alignment {
    /// The pose of the body's markers in the camera frame.
    pub camera_from_markers: Isometry3<f64>,
    /// Its covariance: position (m), then rotation vector (rad), in the camera frame's axes.
    pub covariance: Matrix6<f64>,
    /// Covariance of the point spread, pixels of the sphere image squared, where light is the same all over
    /// a facet.
    pub blur_px2: Matrix2<f64>,
    /// How well the cells agree, where light is the same all over a facet.
    pub score: Score,
    /// The share of the pixels asked that nothing was found to be before.
    pub share_seen: f64,
    /// Pixels that were compared.
    pub samples: usize,
    /// Steps that were taken.
    pub iterations: usize,
}

impl Alignment {
    /// Whether it is a measurement: the body is there, and its pose is known well enough to be of
    /// use to anybody.
    pub fn is_believed(&self) -> bool {
        self.score.is_accepted() && self.is_seen() && self.is_certain()
    }

    /// The same for a body that is tracked: whether it is where it was expected is for the filter to
    /// say, which knows how sure it was.
    pub fn confirms_track(&self) -> bool {
        self.score.confirms() && self.is_seen() && self.is_certain()
    }

    /// The same for a body of which markers were decoded where this pose has them.
    pub fn confirms_marker(&self) -> bool {
        self.score.supports_marker() && self.is_seen() && self.is_certain()
    }

    /// Whether enough of the body is as modelled: facets can agree by chance where an airframe before
    /// them explains the rest. On simulated flights out to 4 m, one of three poses of which less was
    /// seen was wrong by 11 degrees, none of 1894 of which more was by as much as 7.
    fn is_seen(&self) -> bool {
        self.share_seen >= LEAST_SEEN
    }

    fn is_certain(&self) -> bool {
        let deviation = |first| self.covariance.fixed_view::<3, 3>(first, first).trace().sqrt();
        let agrees = self.score.agreeing_facets >= SURE_FACETS
            && self.score.correlation >= AGREES_WELL_CORRELATION;
        let (position_m, rotation_rad) =
            if agrees { MAX_DEVIATIONS_AGREEING } else { MAX_DEVIATIONS };
        deviation(0) < position_m && deviation(3) < rotation_rad
    }
}

/// A pose whose position (m) or rotation (rad) is less certain than this, in all its axes together, is none:
/// where so little is known, mostly because most of the body is hidden, errors are no longer normal. On
/// simulated flights out to 4 m, one that said 32 mm and 4.1 degrees was off by 175 mm, one that said 3.4
/// degrees by 12.
const MAX_DEVIATIONS: (f64, f64) = (0.036, 0.055);

/// The same where three facets agree, and all on average by this. On twelve simulated flights 99 such
/// frames that said 36 to 55 mm or 3.2 to 5.7 degrees were off by 30 mm in the median, by 85 mm and 4.9
/// degrees at most.
const MAX_DEVIATIONS_AGREEING: (f64, f64) = (0.04, 0.087);
const AGREES_WELL_CORRELATION: f64 = 0.8;

/// Why nothing was aligned.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum AlignError {
    /// The view does not show the place, or its numbers are none.
    #[error("the view does not hold the body at that pose")]
    NotInView,
    /// Too little of it faces the camera, or nothing converged.
    #[error("too little of the body can be compared with the view there")]
    Nothing,
}

/// A view with its pixels.
#[derive(Debug, Clone, Copy)]
pub struct Picture<'p> {
    /// The pixels.
    pub image: LumaImage<'p>,
    /// What they show.
    pub view: View,
    /// What light they stand for.
    pub light: &'p LinearLight,
    /// The sphere image's own resolution there, finer than which a magnified view shows nothing.
    pub pixels_per_radian: f64,
}

/// Aligns `print` with what `picture` shows of it, from `start` (`camera_from_markers`). Whether the
/// result is the body is said by its [`Score`].
///
/// # Errors
/// [`AlignError`]: nothing to compare there. Numbers that are none give an error, no panic.
pub fn align(
    print: &BodyPrint,
    picture: &Picture<'_>,
    start: &Isometry3<f64>,
    options: &AlignOptions,
) -> Result<Alignment, AlignError> {
    let frame = Frame::new(print, picture, start, options, 0.0)?;
    let start = frame.state(print, start);
    frame.align(print, start, options)
}

/// Finds `print` within [`REACH_RAD`] of where it was `predicted` (`camera_from_markers`), turned by
/// up to some ten degrees: the most expensive look, for a body that nothing else found. `None`
/// unless the result is believed.
pub fn reacquire(
    print: &BodyPrint,
    picture: &Picture<'_>,
    predicted: &Isometry3<f64>,
    options: &AlignOptions,
) -> Option<Alignment> {
    let frame = Frame::new(print, picture, predicted, options, REACH_RAD).ok()?;
    let state = frame.state(print, predicted);
    let extra_blur_px = SEARCH_CELLS * frame.cell_px(print, predicted);
    if !extra_blur_px.is_finite() {
        return None;
    }
    let reach_px = REACH_RAD * frame.patch.pinhole.focal_px;
    let blurred = frame.patch.blurred(extra_blur_px);
    let places = reacquire::places(&blurred, print, &state, extra_blur_px, reach_px);
    let options = AlignOptions { coarse_first: true, ..*options };
    places
        .into_iter()
        .filter_map(|place| {
            let start = State { patch_from_markers: place.patch_from_markers, ..state.clone() };
            frame.align(print, start, &options).ok().filter(Alignment::is_believed)
        })
        .max_by(|a, b| a.score.log_ratio.total_cmp(&b.score.log_ratio))
}

/// How far from its prediction a body is looked for, radians.
pub const REACH_RAD: f64 = 0.014;
/// Beside the body, its patch shows so many deviations of the point spread of what is behind it.
const BESIDE_BLURS: f64 = 4.0;
/// Extra blur of that search, in the smallest marker's cells.
const SEARCH_CELLS: f64 = 0.6;

fn is_sound(start: &Isometry3<f64>, picture: &Picture<'_>) -> bool {
    start.translation.vector.iter().all(|x| x.is_finite())
        && (start.rotation.quaternion().norm() - 1.0).abs() < 1e-6
        && (picture.view.camera_from_view.quaternion().norm() - 1.0).abs() < 1e-6
        && (1.0..1e6).contains(&picture.view.focal_px)
        && (1.0..1e6).contains(&picture.pixels_per_radian)
}

/// A picture, cut down to what shows a body, and how it is to be fitted.
struct Frame {
    patch: Patch,
    settings: Settings,
}

impl Frame {
    /// What `picture` shows of a body at `start`, and `reach_rad` more all round.
    fn new(
        print: &BodyPrint,
        picture: &Picture<'_>,
        start: &Isometry3<f64>,
        options: &AlignOptions,
        reach_rad: f64,
    ) -> Result<Self, AlignError> {
        if !is_sound(start, picture) {
            return Err(AlignError::NotInView);
        }
        let beside_rad = BESIDE_BLURS * options.blur_px / picture.pixels_per_radian;
        let reach_rad = reach_rad + beside_rad;
        let patch = Patch::cut(picture, start, print.radius_m(), reach_rad, options.widest_px)
            .ok_or(AlignError::NotInView)?;
        let magnification = patch.pinhole.focal_px / picture.pixels_per_radian;
        let blur_px = options.blur_px * magnification;
        // Averaging blocks, and interpolating the view, blur a little more.
        let blur_px = (blur_px.powi(2) + 1.0 / 12.0).sqrt();
        let settings = Settings {
            blur_px,
            blur_variance_px2: 0.5 * blur_px.powi(2),
            extra_blur_px: 0.0,
            iterations: options.iterations,
            magnification,
        };
        Ok(Self { patch, settings })
    }

    /// The unknowns to begin with at a pose in the camera frame.
    fn state(&self, print: &BodyPrint, camera_from_markers: &Isometry3<f64>) -> State {
        State::new(print, self.patch.pose_in(camera_from_markers), self.settings.blur_px)
    }

    /// Side of the smallest marker's cells in the patch.
    fn cell_px(&self, print: &BodyPrint, camera_from_markers: &Isometry3<f64>) -> f64 {
        let range_m = camera_from_markers.translation.vector.norm();
        print.smallest_cell_m() / range_m * self.patch.pinhole.focal_px
    }

    fn align(
        &self,
        print: &BodyPrint,
        start: State,
        options: &AlignOptions,
    ) -> Result<Alignment, AlignError> {
        let Self { patch, settings } = self;
        let mut state = start;
        if options.coarse_first {
            let extra_blur_px = COARSE_CELLS * self.cell_px(print, &state.patch_from_markers);
            let coarse = Settings { extra_blur_px, iterations: COARSE_ITERATIONS, ..*settings };
            if extra_blur_px.is_finite()
                && let Some(fit) =
                    solve::fit(&patch.blurred(extra_blur_px), print, state.clone(), &[], &coarse)
            {
                state = State { blur: state.blur, ..fit.state };
            }
        }
        let (fit, score) = self.fit_what_is_seen(print, state)?;
        let along = self.common_error(print, &fit.patch_from_markers);
        let unnoticed = 1.0 + RIM * (1.0 - fit.share_seen).powi(2);
        let covariance = fit.covariance * (unnoticed * options.covariance_scale) + along;
        let camera_from_patch = patch.view_from_camera.inverse();
        let turn = camera_from_patch.to_rotation_matrix().into_inner();
        let mut axes = Matrix6::zeros();
        axes.fixed_view_mut::<3, 3>(0, 0).copy_from(&turn);
        axes.fixed_view_mut::<3, 3>(3, 3).copy_from(&turn);
        Ok(Alignment {
            camera_from_markers: camera_from_patch * fit.patch_from_markers,
            covariance: axes * covariance * axes.transpose(),
            blur_px2: fit.state.blur / settings.magnification.powi(2),
            score,
            share_seen: fit.share_seen,
            samples: fit.samples.len(),
            iterations: fit.iterations,
        })
    }
}

impl Frame {
    /// Fits the body, then again without the facets that turn out to be hidden: an arm in front of a
    /// facet is dark, and pulls the body nearer than it is.
    fn fit_what_is_seen(
        &self,
        print: &BodyPrint,
        state: State,
    ) -> Result<(Fit, Score), AlignError> {
        let Self { patch, settings } = self;
        let judge = |state: &State, samples: &[Sample]| {
            Verdict::new(patch, print, state, samples, settings.samples_per_pixel())
        };
        let mut fit = solve::fit(patch, print, state, &[], settings).ok_or(AlignError::Nothing)?;
        let mut verdict = judge(&fit.state, &fit.samples);
        let mut left_out = vec![false; print.facets.len()];
        for _ in 0..MOST_REFITS {
            let Some(hidden) = verdict.hidden(print) else { break };
            for (out, hidden) in left_out.iter_mut().zip(hidden) {
                *out |= hidden;
            }
            let Some(again) = solve::fit(patch, print, fit.state.clone(), &left_out, settings)
            else {
                break;
            };
            let anew = judge(&again.state, &again.samples);
            if anew.score.log_ratio < LOST * verdict.score.log_ratio {
                break;
            }
            (fit, verdict) = (again, anew);
        }
        if !fit.is_whole {
            // What was left out is judged all the same.
            verdict = judge(&fit.state, &solve::samples_at(patch, print, &fit.state));
        }
        Ok((fit, verdict.score))
    }

    /// Covariance of what is wrong with all edges at once, and so in no residual: black grows or
    /// shrinks by some hundredths of a pixel with the response, the point spread's shape and what is
    /// before the body unnoticed, and moves the body along the line of sight.
    fn common_error(&self, print: &BodyPrint, patch_from_markers: &Isometry3<f64>) -> Matrix6<f64> {
        let position = patch_from_markers.translation.vector;
        let sphere_px = self.patch.pinhole.focal_px / self.settings.magnification;
        // A body of radius R at range r spans f R/r pixels: an edge's error e is e r^2/(f R) of range.
        let range_m = position.norm_squared() * EDGE_ERROR_PX / (sphere_px * print.radius_m());
        let along = position.normalize() * range_m;
        let mut covariance = Matrix6::zeros();
        covariance.fixed_view_mut::<3, 3>(0, 0).copy_from(&(along * along.transpose()));
        covariance
    }
}

/// Deviation of what all edges are off together, pixels of the sphere image.
const EDGE_ERROR_PX: f64 = 0.012;

/// What hides a body shows through the point spread beyond what is left out, all along its rim: that error
/// grows with the share that is hidden, and the covariance of what is left with the square of it, by this.
/// On simulated flights (seeds 1001 to 1150) NEES was 5 without it where more than 40 % were hidden, and 2.4
/// where nothing was; with it 2.4 to 3.4 everywhere.
const RIM: f64 = 3.0;

/// A fit without hidden facets may have so little of the log-likelihood ratio that it had with them.
const LOST: f64 = 0.8;

/// So often a body is fitted again without what is hidden.
const MOST_REFITS: usize = 2;

/// Extra blur of the coarse fit, in the smallest marker's cells. More made it diverge: what is
/// behind the body bleeds in.
const COARSE_CELLS: f64 = 0.45;
const COARSE_ITERATIONS: usize = 6;

#[cfg(test)]
mod tests;
