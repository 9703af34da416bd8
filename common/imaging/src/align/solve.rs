//! Gauss-Newton over pose, blur, the light of each facet and the seams between them.
//!
//! The light of a pixel is modelled as the sum over the facets that show in it of
//! w (M - K) + b K: M the facet's blurred coverage, K that of its black cells, w and b the light of
//! its white and of its black; of the light behind the body, where the facets leave something of the
//! pixel uncovered (taken for black there, it pulled the range by a tenth of a percent at 2 m); and of
//! lines along the seams between facets, because paper has
//! thickness, folds are round, and where one facet's white ends and the next one's begins is known to a
//! millimetre at best: an edge taken at its word was found to pull the range by a tenth of a percent.
//! Cameras and codecs smooth code values too, not only light, and that moves edges towards what is
//! light: measured, by 0.1 px^2 of variance in views cut from plain frames, 0.25 in H.264.
//! Unknown are six numbers of the pose, three of the point spread's covariance, that variance, w and b
//! of each facet and the light of each seam, all of one step together. In the last step light may also
//! change along each facet, since lamps and windows are some metres away, and arms and hulls keep some of
//! it off; not before, because what hides half a facet would pass for that. Residuals are weighted by Cauchy's
//! function with a scale for each facet, so that a propeller or a shadow on one of them leaves the
//! others alone.

use nalgebra::{Isometry3, Matrix2, Matrix6, Vector3};

use super::blurred::BlurredFacet;
use super::covariance;
use super::geometry::{Pinhole, SeenFacet, seen_facets};
use super::hidden::Hidden;
use super::levels::{facet_scales, fit_levels};
use super::patch::Patch;
use super::print::BodyPrint;
use super::samples::{self, Sample};
use super::sums::Pass;
use super::unknowns::{CODED, COMMON, Layout, State, add_priors, take};

/// A step that moves the body's rim by less, pixels, is the last: the next would be a fraction of it.
const SETTLED_PX: f64 = 0.03;
/// After a step that moves it by less than this, what is still off is something else.
const NEAR_PX: f64 = 0.3;
/// Slopes of the light that would move it by more than this, pixels, are none: then something else is wrong,
/// and it is left where light is the same all over a facet.
const SLOPED_PX: f64 = 0.5;
/// Pixels fewer than this say nothing.
const MIN_SAMPLES: usize = 60;

/// How the fit is done.
#[derive(Debug, Clone, Copy)]
pub(super) struct Settings {
    /// Deviation of the point spread that is expected, pixels, and of that its variance, pixels^2.
    pub blur_px: f64,
    pub blur_variance_px2: f64,
    /// Deviation of a Gaussian that the patch was blurred with beforehand, pixels.
    pub extra_blur_px: f64,
    pub iterations: usize,
    /// Pixels for each of the sphere image's.
    pub magnification: f64,
}

impl Settings {
    /// Samples that count as one: a magnified view's pixels are not independent.
    pub fn samples_per_pixel(&self) -> f64 {
        self.magnification.powi(2).max(1.0)
    }
}

/// A fit's end.
#[derive(Debug, Clone)]
pub(super) struct Fit {
    /// With light that is the same all over each facet.
    pub state: State,
    /// The pose with light that changes along them, if that is next to it; else the state's.
    pub patch_from_markers: Isometry3<f64>,
    /// Its covariance: position (m) and rotation vector, in the patch's axes.
    pub covariance: Matrix6<f64>,
    /// The pixels that it rests on.
    pub samples: Vec<Sample>,
    /// Whether these are all that face the camera: nothing was found to be hidden.
    pub is_whole: bool,
    /// The share of the pixels asked that nothing was found to be before.
    pub share_seen: f64,
    pub iterations: usize,
}

/// Facets as seen and blurred in one state.
pub(super) struct Scene<'p> {
    pub seen: Vec<Option<SeenFacet>>,
    pub blurred: Vec<Option<BlurredFacet<'p>>>,
    /// How code values bend; see [`crate::light::LinearLight::bend`].
    pub code_bend: f64,
}

impl<'p> Scene<'p> {
    pub fn new(print: &'p BodyPrint, state: &State, patch: &Patch, extra_blur_px: f64) -> Self {
        Self::of(print, state, &patch.pinhole, extra_blur_px, patch.code_bend)
    }

    pub fn of(
        print: &'p BodyPrint,
        state: &State,
        pinhole: &Pinhole,
        extra_blur_px: f64,
        code_bend: f64,
    ) -> Self {
        let seen = seen_facets(print, &state.patch_from_markers, pinhole);
        let blur = state.blur + Matrix2::identity() * extra_blur_px.powi(2);
        let blurred = print
            .facets
            .iter()
            .zip(&seen)
            .map(|(facet, seen)| {
                let per_pixel = seen.as_ref()?.facet_from_pixel;
                Some(BlurredFacet::new(facet, &(per_pixel * blur * per_pixel.transpose())))
            })
            .collect();
        Self { seen, blurred, code_bend }
    }

    /// The facet, if it faces the camera.
    #[inline]
    pub fn facet(&self, index: usize) -> Option<(&SeenFacet, &BlurredFacet<'p>)> {
        Some((self.seen[index].as_ref()?, self.blurred[index].as_ref()?))
    }
}

/// A pixel's model: its light, and the derivatives by pose and blur, by the slope of the light of the facet
/// that it lies on (its relative change in a metre along the facet's axes), by facets' levels and by seams.
pub(super) struct Modelled {
    pub light: f64,
    pub by_common: [f64; COMMON],
    pub by_slope: [f64; 2],
    /// Facet, derivative by its white, by its black.
    by_levels: [(usize, f64, f64); 3],
    level_count: usize,
    /// Seam, derivative by its light.
    by_seams: [(usize, f64); 2],
    seam_count: usize,
}

impl Modelled {
    pub fn levels(&self) -> &[(usize, f64, f64)] {
        &self.by_levels[..self.level_count]
    }

    pub fn seams(&self) -> &[(usize, f64)] {
        &self.by_seams[..self.seam_count]
    }
}

/// Models one pixel that lies on the first of `facets` and shows the others as well, with the seams at
/// these edges of the first, and the light `behind` them. A seam's own slope is left out: it is faint where
/// it is right.
#[inline(always)]
pub(super) fn model(
    scene: &Scene<'_>,
    state: &State,
    facets: impl Iterator<Item = usize>,
    seams: impl Iterator<Item = (usize, usize)>,
    behind: f64,
    direction: &Vector3<f64>,
) -> Modelled {
    let mut modelled = Modelled {
        light: behind,
        by_common: [0.0; COMMON],
        by_slope: [0.0; 2],
        by_levels: [(0, 0.0, 0.0); 3],
        level_count: 0,
        by_seams: [(0, 0.0); 2],
        seam_count: 0,
    };
    let mut seams = Some(seams);
    let mut gradient = nalgebra::Vector2::zeros();
    for index in facets {
        // Seams are those of the first, whether it is still seen or not.
        let seams = seams.take();
        let is_first = seams.is_some();
        let Some((seen, blurred)) = scene.facet(index) else { continue };
        let flow = seen.flow(direction);
        let coverage = blurred.coverage(flow.at);
        let black = blurred.black(flow.at);
        let [w, b] = state.levels[index];
        let mix = |m: f32, k: f32| (w - behind) * f64::from(m) + (b - w) * f64::from(k);
        modelled.light += mix(coverage.value, black.value);
        let slope = nalgebra::Vector2::new(
            mix(coverage.slope[0], black.slope[0]),
            mix(coverage.slope[1], black.slope[1]),
        );
        for (sum, by) in modelled.by_common.iter_mut().zip(flow.by_pose(slope)) {
            *sum += by;
        }
        let [xx, xy, yy] = std::array::from_fn(|k| mix(coverage.curvature[k], black.curvature[k]));
        let per_pixel = &seen.facet_from_pixel;
        gradient += per_pixel.transpose() * slope;
        // A Gaussian of a little more covariance adds half the curvature (the heat equation).
        let in_pixels = per_pixel.transpose() * Matrix2::new(xx, xy, xy, yy) * per_pixel;
        modelled.by_common[6] += in_pixels[(0, 0)] / 2.0;
        modelled.by_common[7] += in_pixels[(0, 1)];
        modelled.by_common[8] += in_pixels[(1, 1)] / 2.0;
        let (m, k) = (f64::from(coverage.value), f64::from(black.value));
        if is_first {
            let light = w * (m - k) + b * k;
            modelled.by_slope = [light * flow.at.x, light * flow.at.y];
        }
        if modelled.level_count < modelled.by_levels.len() {
            modelled.by_levels[modelled.level_count] = (index, m - k, k);
            modelled.level_count += 1;
        }
        for (edge, seam) in seams.into_iter().flatten() {
            let by = blurred.line(edge, flow.at);
            modelled.light += state.seams[seam] * by;
            if modelled.seam_count < modelled.by_seams.len() {
                modelled.by_seams[modelled.seam_count] = (seam, by);
                modelled.seam_count += 1;
            }
        }
    }
    // Code values c(L) that are blurred by a variance v change light by v/2 (lap L + c''/c' |grad L|^2).
    // The first is blur like any other.
    let bend = -0.5 * scene.code_bend * gradient.norm_squared() / modelled.light.max(DARKEST);
    modelled.by_common[CODED] = bend;
    modelled.light += bend * state.coded_blur;
    modelled
}

/// Light less than this, of nominal white, is noise.
const DARKEST: f64 = 0.01;

/// Fits a body to a patch, from `start`, by what faces the camera and is not hidden: neither one of
/// these `facets` (none if that is empty), nor behind what is found to be before it. `None` where
/// nothing of it is seen, or nothing converges.
pub(super) fn fit(
    patch: &Patch,
    print: &BodyPrint,
    start: State,
    facets: &[bool],
    settings: &Settings,
) -> Option<Fit> {
    let mut state = start;
    let mut hidden = Hidden::of_facets(facets);
    let mut knows_hidden = false;
    let (mut samples, mut layout, mut scales) = begin(patch, print, &mut state, &hidden, settings)?;
    let mut begun_at = state.patch_from_markers;
    for iteration in 1.. {
        let scene = Scene::new(print, &state, patch, settings.extra_blur_px);
        let is_robust = iteration > 1;
        let pass =
            Pass { print, patch, samples: &samples, layout: &layout, scales: &scales, is_robust };
        let mut sums = pass.sum(&scene, &state);
        let seen = sums.normal.clone();
        add_priors(&mut sums.normal, &mut sums.right, &state, &layout, settings);
        let even = ..layout.even;
        let normal = sums.normal.view_range(even, even).into_owned().cholesky()?;
        let step = normal.solve(&sums.right.rows_range(even));
        let before = state.clone();
        let moved = take(&mut state, &step, &layout, patch)?;
        if is_robust && knows_hidden && (moved < SETTLED_PX || iteration >= settings.iterations) {
            let of_pose = |normal: &_, seen: &_, explains: f64| {
                let residuals = &sums.residuals;
                covariance::of_pose(normal, seen, explains, patch, &samples, residuals, &scales)
            };
            let with_slopes = || {
                let normal = sums.normal.clone().cholesky()?;
                let step = normal.solve(&sums.right);
                let mut sloped = before;
                let moved = take(&mut sloped, &step, &layout, patch)?;
                let covariance = of_pose(&normal, &seen, step.dot(&sums.right))?;
                (moved < SLOPED_PX).then_some((sloped.patch_from_markers, covariance))
            };
            let (patch_from_markers, covariance) = match with_slopes() {
                Some(found) => found,
                None => {
                    let seen = seen.view_range(even, even).into_owned();
                    (state.patch_from_markers, of_pose(&normal, &seen, 0.0)?)
                }
            };
            return Some(Fit {
                state,
                patch_from_markers,
                covariance,
                samples,
                is_whole: hidden.is_empty(),
                share_seen: hidden.share_seen(),
                iterations: iteration,
            });
        }
        scales = facet_scales(&samples, &sums.residuals, scales.len());
        // Where the body moved by half a pixel, other pixels show it.
        let mut others_show_it =
            shift_px(&begun_at, &state.patch_from_markers, print.radius_m(), patch) > 0.5;
        let is_near = is_robust && (moved < NEAR_PX || iteration + 2 >= settings.iterations);
        if is_near && !knows_hidden {
            knows_hidden = true;
            hidden.add_pixels(patch, &state, &scales, &samples, &sums.residuals);
            others_show_it |= hidden.has_pixels();
        }
        if others_show_it {
            (samples, layout, scales) = begin(patch, print, &mut state, &hidden, settings)?;
            begun_at = state.patch_from_markers;
        }
    }
    None
}

/// The pixels that show the body in a state, whatever hides it.
pub(super) fn samples_at(patch: &Patch, print: &BodyPrint, state: &State) -> Vec<Sample> {
    let scene = Scene::new(print, state, patch, 0.0);
    samples::choose(patch, &print.facets, &scene.seen, &scene.blurred)
}

/// The samples at a state, the unknowns they show, and the noise; the facets' light is found.
fn begin(
    patch: &Patch,
    print: &BodyPrint,
    state: &mut State,
    hidden: &Hidden,
    settings: &Settings,
) -> Option<(Vec<Sample>, Layout, Vec<f64>)> {
    let scene = Scene::new(print, state, patch, settings.extra_blur_px);
    let mut samples = samples::choose(patch, &print.facets, &scene.seen, &scene.blurred);
    samples.retain(|sample| !hidden.holds(sample));
    if samples.len() < MIN_SAMPLES {
        return None;
    }
    let layout = Layout::new(print, &scene, &samples);
    let scales = fit_levels(patch, &scene, &samples, &layout, state)?;
    Some((samples, layout, scales))
}

/// How far the rim of a body moves from one pose to another, pixels.
fn shift_px(from: &Isometry3<f64>, to: &Isometry3<f64>, radius_m: f64, patch: &Patch) -> f64 {
    let range = from.translation.vector.norm();
    let shift = (to.translation.vector - from.translation.vector).norm();
    let turn = radius_m * from.rotation.angle_to(&to.rotation);
    (shift + turn) / range * patch.pinhole.focal_px
}
