//! The forward model: the radiance that a pixel should have, and its derivatives by the unknowns.
//!
//! The radiance of a pixel is a sum over the facets that show in it,
//!
//! ```text
//! I = B + sum over facets of ( w (M - K) + b K - B M ) + lines along the seams
//! ```
//!
//! | symbol | meaning |
//! | --- | --- |
//! | M, K | blurred coverage of the facet and of its black cells ([`blurred`]) |
//! | w, b | white and black level of the facet |
//! | B | radiance of the background, where the facets leave part of the pixel uncovered |
//!
//! The background is measured beside the body. Taken as black, it biased the range by 0.1 % at 2 m.
//!
//! Each seam between two facets may add or take away some radiance. Paper has thickness, folds are
//! round, and the end of one facet's white is known to a millimetre at best. Without this line, a
//! seam biased the range by a tenth of a percent.
//!
//! A camera's response may differ from the assumed one. Then the apparent radiance between black and
//! white is I + t (I - b)(w - I) / (w - b), with one more unknown t.
//!
//! Cameras and codecs smooth code values too, which moves edges towards the bright side. That *code
//! blur* is one more unknown.

pub(super) mod blurred;
pub(super) mod geometry;

use nalgebra::{Isometry3, Matrix2, Vector2, Vector3};

use super::patch::Patch;
use super::pinhole::Pinhole;
use super::print::BodyPrint;
use super::spread::Spread;
use super::state::{CODE_BLUR, COMMON, RESPONSE, SPREAD, State};
use blurred::BlurredFacet;
use geometry::{VisibleFacet, visible_facets};

/// Radiance below this share of nominal white is noise.
const DARKEST: f64 = 0.01;

/// Largest effect of a wrong response, as a share of a facet's contrast: that in its middle.
const MOST_BENT: f64 = 0.25;

/// Least share of the blur's variance that is the camera's own.
const LEAST_RESPONSE_SHARE: f64 = 0.05;

/// The most facets that show in one pixel.
const MAX_FACETS: usize = 3;

/// The facets in one state, as the camera sees them.
pub(super) struct Scene<'p> {
    pub print: &'p BodyPrint,
    /// The facets in each half of a stitched picture that shows them; elsewhere in the one picture.
    pub halves: Vec<SeenFacets<'p>>,
    /// Curvature of the camera's curve; see [`crate::light::LinearLight::bend`].
    pub code_bend: f64,
    /// How much of a wrong response's effect is left after the smoothing of code values.
    pub response_share: f64,
}

/// The facets as one half of a picture shows them.
#[derive(Clone)]
pub(super) struct SeenFacets<'p> {
    /// The facets that face the camera; `None` for the others.
    pub visible: Vec<Option<VisibleFacet>>,
    /// The facets with the point spread in their planes.
    pub blurred: Vec<Option<BlurredFacet<'p>>>,
}

impl<'p> SeenFacets<'p> {
    fn new(
        print: &'p BodyPrint,
        patch_from_markers: &Isometry3<f64>,
        spread: &Spread,
        pinhole: &Pinhole,
        extra_blur_px: f64,
    ) -> Self {
        let visible = visible_facets(print, patch_from_markers, pinhole);
        let blur = spread.of_part() + Matrix2::identity() * extra_blur_px.powi(2);
        let blurred = print
            .facets
            .iter()
            .zip(&visible)
            .map(|(facet, visible)| {
                let per_pixel = visible.as_ref()?.facet_from_pixel;
                let covariance = per_pixel * blur * per_pixel.transpose();
                let path = per_pixel * spread.path_px;
                Some(BlurredFacet::new(facet, &covariance, &path, spread.parts))
            })
            .collect();
        Self { visible, blurred }
    }

    /// The facet, if it faces the camera.
    #[inline]
    pub(super) fn facet(&self, index: usize) -> Option<(&VisibleFacet, &BlurredFacet<'p>)> {
        Some((self.visible[index].as_ref()?, self.blurred[index].as_ref()?))
    }
}

/// Index, blurred white share and blurred black share of each facet in a pixel, and their count.
pub(super) type FacetShares = ([(usize, f64, f64); MAX_FACETS], usize);

impl<'p> Scene<'p> {
    pub(super) fn new(print: &'p BodyPrint, state: &State, patch: &Patch) -> Self {
        let Patch { pinhole, extra_blur_px, code_bend, .. } = patch;
        let mut halves: Vec<SeenFacets<'p>> = patch
            .halves
            .poses(&state.patch_from_markers, &state.constants)
            .map(|pose| SeenFacets::new(print, &pose, &state.spread, pinhole, *extra_blur_px))
            .collect();
        if let [one, other] = &mut halves[..] {
            // The unknowns of a facet are the same in both halves.
            for index in 0..print.facets.len() {
                if one.visible[index].is_none() || other.visible[index].is_none() {
                    (one.visible[index], other.visible[index]) = (None, None);
                }
            }
        }
        let mut scene = Self { print, halves, code_bend: *code_bend, response_share: 1.0 };
        // The camera encodes light that lens and motion have blurred. Smoothing spreads the effect over
        // the wider edge, and does not change its sum.
        let blur_px2 = state.spread.whole().trace() / 2.0;
        let share = (1.0 - patch.smoothing_px2 / blur_px2).max(LEAST_RESPONSE_SHARE);
        let blurred_px2 = blur_px2 + patch.extra_blur_px.powi(2);
        scene.response_share = (share * blur_px2 / blurred_px2).sqrt();
        scene
    }

    pub(super) fn of(
        print: &'p BodyPrint,
        state: &State,
        pinhole: &Pinhole,
        extra_blur_px: f64,
        code_bend: f64,
    ) -> Self {
        let pose = &state.patch_from_markers;
        let seen = SeenFacets::new(print, pose, &state.spread, pinhole, extra_blur_px);
        Self { print, halves: vec![seen], code_bend, response_share: 1.0 }
    }

    /// The facet in a half, if it faces the camera.
    #[inline]
    pub(super) fn facet(
        &self,
        half: usize,
        index: usize,
    ) -> Option<(&VisibleFacet, &BlurredFacet<'p>)> {
        self.halves[half].facet(index)
    }

    /// Shares of white and black of the `facets` that face the camera, in the pixel of a half at
    /// `direction`.
    pub(super) fn shares(
        &self,
        half: usize,
        facets: impl Iterator<Item = usize>,
        direction: &Vector3<f64>,
    ) -> FacetShares {
        let mut row = [(0, 0.0, 0.0); MAX_FACETS];
        let mut used = 0;
        for index in facets {
            let Some((visible, blurred)) = self.facet(half, index) else { continue };
            let at = visible.point(direction);
            let black = f64::from(blurred.black(at).value);
            let white = f64::from(blurred.coverage(at).value) - black;
            row[used] = (index, white, black);
            used += 1;
        }
        (row, used)
    }
}

/// The modelled radiance of one pixel, and its derivatives.
pub(super) struct Modelled {
    pub radiance: f64,
    /// Derivatives by pose, point spread, code blur and response.
    pub by_common: [f64; COMMON],
    /// Derivatives by the radiance gradient of the facet that the pixel lies on, along x and y.
    pub by_gradient: [f64; 2],
    /// Facet, derivative by its white level, derivative by its black level.
    by_levels: [(usize, f64, f64); MAX_FACETS],
    level_count: usize,
    /// Seam, derivative by its radiance.
    by_seams: [(usize, f64); 2],
    seam_count: usize,
}

impl Modelled {
    /// Facet, derivative by its white level, derivative by its black level.
    pub(super) fn levels(&self) -> &[(usize, f64, f64)] {
        &self.by_levels[..self.level_count]
    }

    /// Applies a response that differs from the assumed one by `bend`; see
    /// [`SeenBend`](super::solve::SeenBend), of whose effect `share` is left. `levels` are white and
    /// black of the first facet.
    #[inline(always)]
    fn bend(&mut self, bend: f64, share: f64, [w, b]: [f64; 2]) {
        // Without a first facet there is no black and white.
        let contrast = w - b;
        if contrast < DARKEST {
            return;
        }
        let (above, below) = ((self.radiance - b) / contrast, (w - self.radiance) / contrast);
        // Beyond black and white a parabola would soon be far from any response.
        let is_between = above * below > -MOST_BENT;
        let bent = if is_between { above * below } else { -MOST_BENT };
        self.by_common[RESPONSE] = share * bent * contrast;
        let bend = share * bend;
        if bend != 0.0 && is_between {
            let slope = 1.0 + bend * (below - above);
            self.by_common[..RESPONSE].iter_mut().for_each(|by| *by *= slope);
            self.by_gradient = self.by_gradient.map(|by| by * slope);
            for (_, by_white, by_black) in &mut self.by_levels[..self.level_count] {
                *by_white *= slope;
                *by_black *= slope;
            }
            self.by_seams[..self.seam_count].iter_mut().for_each(|(_, by)| *by *= slope);
            if let Some((_, by_white, by_black)) = self.by_levels[..self.level_count].first_mut() {
                *by_white += bend * above * above;
                *by_black -= bend * below * below;
            }
        }
        self.radiance += bend * bent * contrast;
    }

    /// Seam, derivative by its radiance.
    pub(super) fn seams(&self) -> &[(usize, f64)] {
        &self.by_seams[..self.seam_count]
    }
}

/// Models one pixel of a half that lies on the first of `facets` and also shows the others.
///
/// `seams` are (edge of the first facet, seam) within reach of the pixel, `background` is the
/// radiance next to the body. The motion of a seam's line with the pose is left out, because the
/// line is faint.
#[inline(always)]
pub(super) fn model(
    scene: &Scene<'_>,
    state: &State,
    half: usize,
    facets: impl Iterator<Item = usize>,
    seams: impl Iterator<Item = (usize, usize)>,
    background: f64,
    direction: &Vector3<f64>,
) -> Modelled {
    let mut modelled = Modelled {
        radiance: background,
        by_common: [0.0; COMMON],
        by_gradient: [0.0; 2],
        by_levels: [(0, 0.0, 0.0); MAX_FACETS],
        level_count: 0,
        by_seams: [(0, 0.0); 2],
        seam_count: 0,
    };
    let mut seams = Some(seams);
    let mut image_gradient = Vector2::zeros();
    let mut first_levels = [0.0; 2];
    for index in facets {
        // The seams belong to the first facet, even if it does not face the camera any more.
        let seams = seams.take();
        let is_first = seams.is_some();
        let Some((visible, blurred)) = scene.facet(half, index) else { continue };
        let flow = visible.flow(direction);
        let coverage = blurred.coverage(flow.at);
        let black = blurred.black(flow.at);
        let [w, b] = state.levels[index];
        let mix = |m: f32, k: f32| (w - background) * f64::from(m) + (b - w) * f64::from(k);
        modelled.radiance += mix(coverage.value, black.value);
        let slope = Vector2::new(
            mix(coverage.slope[0], black.slope[0]),
            mix(coverage.slope[1], black.slope[1]),
        );
        for (sum, by) in modelled.by_common.iter_mut().zip(flow.by_pose(slope)) {
            *sum += by;
        }
        let [xx, xy, yy] = std::array::from_fn(|k| mix(coverage.curvature[k], black.curvature[k]));
        let per_pixel = &visible.facet_from_pixel;
        image_gradient += per_pixel.transpose() * slope;
        let in_pixels = per_pixel.transpose() * Matrix2::new(xx, xy, xy, yy) * per_pixel;
        let by_path = Vector2::from_fn(|k, _| mix(coverage.by_path[k], black.by_path[k]));
        let by_spread = state.spread.derivatives(&in_pixels, &(per_pixel.transpose() * by_path));
        for (sum, by) in modelled.by_common[SPREAD..].iter_mut().zip(by_spread) {
            *sum += by;
        }
        let (m, k) = (f64::from(coverage.value), f64::from(black.value));
        if is_first {
            let radiance = w * (m - k) + b * k;
            modelled.by_gradient = [radiance * flow.at.x, radiance * flow.at.y];
            first_levels = [w, b];
        }
        if modelled.level_count < modelled.by_levels.len() {
            modelled.by_levels[modelled.level_count] = (index, m - k, k);
            modelled.level_count += 1;
        }
        for (edge, seam) in seams.into_iter().flatten() {
            let by = blurred.line(edge, flow.at);
            modelled.radiance += state.seams[seam] * by;
            if modelled.seam_count < modelled.by_seams.len() {
                modelled.by_seams[modelled.seam_count] = (seam, by);
                modelled.seam_count += 1;
            }
        }
    }
    modelled.bend(state.response, scene.response_share, first_levels);
    // Blurring code values c(L) by a variance v changes radiance by v/2 (lap L + c''/c' |grad
    // L|^2). The first term is blur like any other.
    let bend =
        -0.5 * scene.code_bend * image_gradient.norm_squared() / modelled.radiance.max(DARKEST);
    modelled.by_common[CODE_BLUR] = bend;
    modelled.radiance += bend * state.code_blur;
    modelled
}

/// Motion of the body's rim from one pose to another, pixels.
pub(super) fn rim_shift_px(
    from: &Isometry3<f64>,
    to: &Isometry3<f64>,
    radius_m: f64,
    focal_px: f64,
) -> f64 {
    let range = from.translation.vector.norm();
    let shift = (to.translation.vector - from.translation.vector).norm();
    let turn = radius_m * from.rotation.angle_to(&to.rotation);
    (shift + turn) / range * focal_px
}
