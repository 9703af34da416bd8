//! The unknowns of an alignment: their values, their places in the normal equations, their priors.

use flockeye_geometry::pose::{PoseEstimate, pose_difference, turned_covariance};
use nalgebra::{
    DMatrix, DVector, Isometry3, Matrix5, Matrix6, Translation3, Unit, UnitQuaternion, Vector2,
    Vector3, Vector5,
};

use super::print::BodyPrint;
use super::spread::Spread;

/// Unknowns that do not belong to one facet: six of the pose, three of the point spread, one of the
/// code blur, one of the response.
pub(super) const COMMON: usize = 11;
/// Index of the first unknown of the point spread.
pub(super) const SPREAD: usize = 6;
/// Index of the code blur.
pub(super) const CODE_BLUR: usize = 9;
/// Index of the response.
pub(super) const RESPONSE: usize = 10;
/// Number of the constants of a stitched camera.
pub(super) const CONSTANTS: usize = 5;
/// Code blur, expected value and standard deviation, pixels of the sphere image squared. Measured:
/// 0.1 in views cut from plain frames, 0.25 after H.264.
const CODE_BLUR_PRIOR_PX2: (f64, f64) = (0.1, 0.15);
/// Least standard deviation of the response. It moves edges by less than a thousandth of a pixel.
const MIN_RESPONSE_SIGMA: f64 = 1e-3;
/// Black as a share of white, expected value and standard deviation.
pub(super) const BLACK_SHARE_PRIOR: (f64, f64) = (0.06, 0.12);
/// Standard deviation of a seam's radiance, as the width in metres of a line as bright as white.
/// Bodies are folded, glued and bevelled, so the radiance along a seam is not known beforehand.
const SEAM_SIGMA_M: f64 = 6e-5;
/// Standard deviation of the radiance gradient along a facet, relative to its radiance, per metre.
/// It is that of a facet three metres from a lamp: 2 % from the middle of a facet of 6 cm to its
/// edge. Arms and hulls near the body shade more than that.
const GRADIENT_SIGMA_PER_M: f64 = 0.7;

/// Values of the unknowns.
#[derive(Debug, Clone)]
pub(super) struct State {
    /// Pose of the markers in the patch's frame, whose axes are the view's.
    pub patch_from_markers: Isometry3<f64>,
    /// The point spread.
    pub spread: Spread,
    /// Variance of the blur that acts on code values instead of radiance, pixels squared.
    pub code_blur: f64,
    /// How much the camera's response differs from the assumed one; see
    /// [`SeenBend`](super::solve::SeenBend).
    pub response: f64,
    /// How much the constants of a stitched camera differ from the assumed ones. Zero where one half
    /// shows all of the body.
    pub constants: Vector5<f64>,
    /// White and black level of each facet.
    pub levels: Vec<[f64; 2]>,
    /// Additional radiance of each seam between two facets, as a line without width: radiance times
    /// metres.
    pub seams: Vec<f64>,
}

impl State {
    /// Creates the state of a body at a pose with the expected point spread. Its white and black
    /// levels are not known yet.
    pub(super) fn new(
        print: &BodyPrint,
        patch_from_markers: Isometry3<f64>,
        prior: &Prior,
    ) -> Self {
        let mut spread = prior.spread;
        spread.limit();
        Self {
            patch_from_markers,
            spread,
            code_blur: 0.0,
            response: 0.0,
            constants: Vector5::zeros(),
            levels: vec![[0.0; 2]; print.facets.len()],
            seams: vec![0.0; print.seams],
        }
    }
}

/// Expected point spread and pose, and the scale between pixels of the patch and of the sphere
/// image.
#[derive(Debug, Clone, Copy)]
pub(super) struct Prior {
    /// The expected point spread.
    pub spread: Spread,
    /// Standard deviations of its unknowns.
    pub spread_sigmas: [f64; 3],
    /// Direction of the apparent motion in the patch; `None` where it is not known.
    pub motion: Option<Unit<Vector2<f64>>>,
    /// Pixels of the patch for each pixel of the sphere image, along one axis.
    pub magnification: f64,
    /// Standard deviation of the response's difference from the assumed one.
    pub response_sigma: f64,
    /// Inverse covariance of the constants of a stitched camera; `None` where one half shows all of
    /// the body.
    pub constants: Option<Matrix5<f64>>,
    /// Prediction of the pose; `None` where it is not known.
    pub pose: Option<PosePrior>,
}

/// Prediction of a body's pose in the patch.
#[derive(Debug, Clone, Copy)]
pub(super) struct PosePrior {
    patch_from_markers: Isometry3<f64>,
    /// Inverse covariance, scaled: position (m), then rotation vector (rad), in the patch's axes.
    information: Matrix6<f64>,
}

impl PosePrior {
    /// A prediction in the camera frame, for a patch with these axes. Its information is multiplied
    /// by `scale`. `None` where its covariance has no inverse.
    pub(super) fn new(
        patch_from_camera: &UnitQuaternion<f64>,
        predicted: &PoseEstimate,
        scale: f64,
    ) -> Option<Self> {
        let covariance = turned_covariance(patch_from_camera, &predicted.covariance);
        Some(Self {
            patch_from_markers: patch_from_camera * predicted.camera_from_markers,
            information: covariance.cholesky()?.inverse() * scale,
        })
    }

    /// Adds the prediction to the normal equations, in which samples count `weight` times as much
    /// as independent measurements.
    pub(super) fn add(
        &self,
        normal: &mut DMatrix<f64>,
        right: &mut DVector<f64>,
        patch_from_markers: &Isometry3<f64>,
        weight: f64,
    ) {
        let information = self.information * weight;
        let difference = pose_difference(&self.patch_from_markers, patch_from_markers);
        let mut of_pose = normal.fixed_view_mut::<6, 6>(0, 0);
        of_pose += information;
        let mut of_pose = right.fixed_rows_mut::<6>(0);
        of_pose += information * difference;
    }
}

impl Prior {
    /// A lens with this point spread, its standard deviation in pixels of the patch, and a body
    /// that moves by `path_px` during the exposure and in the direction `motion`.
    pub(super) fn new(
        lens_px: f64,
        path_px: Vector2<f64>,
        motion: Option<Unit<Vector2<f64>>>,
        magnification: f64,
    ) -> Self {
        let (spread, spread_sigmas) = Spread::expected(lens_px, path_px);
        let response_sigma = MIN_RESPONSE_SIGMA;
        let (constants, pose) = (None, None);
        Self { spread, spread_sigmas, motion, magnification, response_sigma, constants, pose }
    }

    /// Variance of a point spread along the motion, less that across it, pixels of the sphere image
    /// squared.
    pub(super) fn stretch_px2(&self, spread: &Spread) -> Option<f64> {
        let along = self.motion?.into_inner();
        let across = Vector2::new(-along.y, along.x);
        let whole = spread.whole();
        let variance = |axis: Vector2<f64>| axis.dot(&(whole * axis));
        Some((variance(along) - variance(across)) / self.magnification.powi(2))
    }

    /// Precision of the response's prior in the normal equations.
    pub(super) fn response_precision(&self) -> f64 {
        self.samples_per_pixel() / self.response_sigma.max(MIN_RESPONSE_SIGMA).powi(2)
    }

    /// Number of samples with the information of one independent sample: pixels of a magnified view
    /// are not independent.
    pub(super) fn samples_per_pixel(&self) -> f64 {
        self.magnification.powi(2).max(1.0)
    }
}

/// Index of each unknown of facets and seams in the normal equations.
///
/// Facets that face away and seams without samples have no index. The radiance gradients come last,
/// so that all other unknowns can be solved for without them.
#[derive(Debug)]
pub(super) struct Layout {
    /// Index of each facet's white level; its black level is the next.
    pub levels: Vec<Option<usize>>,
    /// Index of each seam's radiance.
    pub seams: Vec<Option<usize>>,
    /// Index of the first constant of a stitched camera.
    pub constants: Option<usize>,
    /// Number of unknowns without the radiance gradients.
    pub uniform_count: usize,
    /// Number of all unknowns.
    pub count: usize,
}

impl Layout {
    /// Creates the layout. `is_visible` states for each facet whether it faces the camera;
    /// `seams_shown` are the seams in the samples, in their order. `has_constants`: two halves of a
    /// stitched picture show the body.
    pub(super) fn new(
        is_visible: impl Iterator<Item = bool>,
        seam_count: usize,
        seams_shown: impl Iterator<Item = usize>,
        has_constants: bool,
    ) -> Self {
        let mut count = COMMON;
        let levels: Vec<_> = is_visible
            .map(|is_visible| {
                is_visible.then(|| {
                    count += 2;
                    count - 2
                })
            })
            .collect();
        let mut seams = vec![None; seam_count];
        for seam in seams_shown {
            seams[seam].get_or_insert_with(|| {
                count += 1;
                count - 1
            });
        }
        let constants = has_constants.then_some(count);
        let uniform_count = if has_constants { count + CONSTANTS } else { count };
        let facets = levels.iter().flatten().count();
        Self { levels, seams, constants, uniform_count, count: uniform_count + 2 * facets }
    }

    /// Index of a facet's radiance gradient along its x axis; that along y is the next.
    pub(super) fn gradient(&self, facet: usize) -> Option<usize> {
        // Levels come in pairs too, in the same order.
        Some(self.uniform_count + (self.levels[facet]? - COMMON))
    }

    /// Facets with an index, and the index of their white level.
    pub(super) fn facets(&self) -> impl Iterator<Item = (usize, usize)> {
        self.levels.iter().enumerate().filter_map(|(facet, at)| Some((facet, (*at)?)))
    }

    fn shown_seams(&self) -> impl Iterator<Item = (usize, usize)> {
        self.seams.iter().enumerate().filter_map(|(seam, at)| Some((seam, (*at)?)))
    }
}

/// Adds the priors to the normal equations.
///
/// They favour the expected point spread, black as a small share of white, uniform radiance over each
/// facet, and faint seams.
pub(super) fn add_priors(
    normal: &mut DMatrix<f64>,
    right: &mut DVector<f64>,
    state: &State,
    layout: &Layout,
    prior: &Prior,
) {
    // Dependent samples are summed as if they were independent. The priors grow with them, so that
    // their relative weight stays.
    let share = prior.samples_per_pixel();
    let (wanted, is) = (prior.spread.unknowns(), state.spread.unknowns());
    for (k, sigma) in prior.spread_sigmas.into_iter().enumerate() {
        let (at, precision) = (SPREAD + k, share / sigma.powi(2));
        normal[(at, at)] += precision;
        right[at] += precision * (wanted[k] - is[k]);
    }
    let (wanted, sigma) = CODE_BLUR_PRIOR_PX2;
    let scale = prior.magnification.powi(2);
    let precision = share / (sigma * scale).powi(2);
    normal[(CODE_BLUR, CODE_BLUR)] += precision;
    right[CODE_BLUR] += precision * (wanted * scale - state.code_blur);
    let precision = prior.response_precision();
    normal[(RESPONSE, RESPONSE)] += precision;
    right[RESPONSE] -= precision * state.response;
    if let Some((at, information)) = layout.constants.zip(prior.constants) {
        let information = information * share;
        let mut of_constants = normal.fixed_view_mut::<CONSTANTS, CONSTANTS>(at, at);
        of_constants += information;
        let mut of_constants = right.fixed_rows_mut::<CONSTANTS>(at);
        of_constants -= information * state.constants;
    }
    let (black, sigma) = BLACK_SHARE_PRIOR;
    let mut brightest: f64 = 0.01;
    for (facet, at) in layout.facets() {
        let [w, b] = state.levels[facet];
        brightest = brightest.max(w);
        let precision = share / (sigma * w.abs().max(0.01)).powi(2);
        // The equation b - black w = 0.
        let residual = black * w - b;
        normal[(at, at)] += precision * black * black + 1e-6;
        normal[(at + 1, at + 1)] += precision + 1e-6;
        normal[(at, at + 1)] -= precision * black;
        normal[(at + 1, at)] -= precision * black;
        right[at] -= precision * black * residual;
        right[at + 1] += precision * residual;
        if let Some(at) = layout.gradient(facet) {
            normal[(at, at)] += share / GRADIENT_SIGMA_PER_M.powi(2);
            normal[(at + 1, at + 1)] += share / GRADIENT_SIGMA_PER_M.powi(2);
        }
    }
    for (seam, at) in layout.shown_seams() {
        let precision = share / (SEAM_SIGMA_M * brightest).powi(2);
        normal[(at, at)] += precision;
        right[at] -= precision * state.seams[seam];
    }
}

/// Applies a step, shortened where it is too long, without its radiance gradients.
///
/// Returns the motion of the body in a patch of this focal length, pixels. `None` for a step that
/// is not finite.
pub(super) fn apply_step(
    state: &mut State,
    step: &DVector<f64>,
    layout: &Layout,
    focal_px: f64,
) -> Option<f64> {
    if !step.iter().all(|x| x.is_finite()) {
        return None;
    }
    let pose = &state.patch_from_markers;
    let position = pose.translation.vector;
    let shift = Vector3::new(step[0], step[1], step[2]);
    let turn = Vector3::new(step[3], step[4], step[5]);
    let sight = position.normalize();
    let along = shift.dot(&sight);
    let across = (shift - sight * along).norm() / position.norm() * focal_px;
    let largest = (turn.norm() / 0.1).max(across / 2.0).max(along.abs() / position.norm() / 0.05);
    let share = 1.0 / largest.max(1.0);
    state.patch_from_markers = Isometry3::from_parts(
        Translation3::from(position + shift * share),
        UnitQuaternion::from_scaled_axis(turn * share) * pose.rotation,
    );
    state.spread.add(std::array::from_fn(|k| step[SPREAD + k] * share));
    state.code_blur += step[CODE_BLUR] * share;
    state.response += step[RESPONSE] * share;
    if let Some(at) = layout.constants {
        state.constants += step.fixed_rows::<CONSTANTS>(at) * share;
    }
    for (facet, at) in layout.facets() {
        state.levels[facet][0] += step[at];
        state.levels[facet][1] += step[at + 1];
    }
    for (seam, at) in layout.shown_seams() {
        state.seams[seam] += step[at];
    }
    let turned = turn.norm() * 0.08 / position.norm() * focal_px;
    let nearer = along.abs() / position.norm() * 0.08 / position.norm() * focal_px;
    Some(across.max(turned).max(nearer) * share)
}
