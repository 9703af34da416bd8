//! What is unknown of a body in a patch, and where each number stands among the others.

use nalgebra::{DMatrix, DVector, Isometry3, Matrix2, Translation3, UnitQuaternion, Vector3};

use super::patch::Patch;
use super::print::BodyPrint;
use super::samples::Sample;
use super::solve::{Scene, Settings};

/// Unknowns of pose, blur and coded blur.
pub(super) const COMMON: usize = 10;
/// Place of the coded blur among them.
pub(super) const CODED: usize = 9;
/// Variance that code values are blurred by, and how far it may be off that, pixels of the sphere
/// image squared.
const CODED_BLUR_PX2: (f64, f64) = (0.1, 0.15);
/// Black as a share of white, and how far it may be off that.
pub(super) const BLACK_SHARE: (f64, f64) = (0.06, 0.12);
/// What a seam between two facets may add to the light or take from it: so wide a line of the
/// facets' own white, metres. Bodies are folded, glued and bevelled, and edges lie where they may.
const SEAM_M: f64 = 6e-5;
/// By what share of itself a facet's light may change in a metre, as it does three metres from a lamp: 2 %
/// from the middle of a facet of 6 cm to its edge. Arms and hulls next to the body keep more of it off.
const SLOPE_PER_M: f64 = 0.7;
/// Narrowest and widest point spread, pixels.
const BLUR_PX: (f64, f64) = (0.35, 6.0);

/// The unknowns' values.
#[derive(Debug, Clone)]
pub(super) struct State {
    /// The markers' pose in the patch's frame, whose axes are the view's.
    pub patch_from_markers: Isometry3<f64>,
    /// Covariance of the point spread, pixels squared.
    pub blur: Matrix2<f64>,
    /// Variance that code values, not light, were blurred by, pixels squared.
    pub coded_blur: f64,
    /// Light of each facet's white and black.
    pub levels: Vec<[f64; 2]>,
    /// Light that the seams between facets add, as a line of no width: light times metres.
    pub seams: Vec<f64>,
}

impl State {
    /// A body at a pose, its light unknown yet.
    pub fn new(print: &BodyPrint, patch_from_markers: Isometry3<f64>, blur_px: f64) -> Self {
        Self {
            patch_from_markers,
            blur: Matrix2::identity() * blur_px.powi(2),
            coded_blur: 0.0,
            levels: vec![[0.0; 2]; print.facets.len()],
            seams: vec![0.0; print.seams()],
        }
    }
}

/// Where the unknowns of facets and seams stand; facets that face away, and seams that no sample shows,
/// have no place. The slopes of facets' light come last, so that all others can be solved for without them.
#[derive(Debug)]
pub(super) struct Layout {
    levels: Vec<Option<usize>>,
    seams: Vec<Option<usize>>,
    /// How many there are while light is the same all over a facet, and in all.
    pub even: usize,
    pub count: usize,
}

impl Layout {
    pub fn new(print: &BodyPrint, scene: &Scene<'_>, samples: &[Sample]) -> Self {
        let mut count = COMMON;
        let levels: Vec<_> = scene
            .seen
            .iter()
            .map(|seen| {
                seen.as_ref()?;
                count += 2;
                Some(count - 2)
            })
            .collect();
        let mut seams = vec![None; print.seams()];
        for sample in samples {
            for (_, seam) in sample.seams(print) {
                seams[seam].get_or_insert_with(|| {
                    count += 1;
                    count - 1
                });
            }
        }
        let facets = levels.iter().flatten().count();
        Self { levels, seams, even: count, count: count + 2 * facets }
    }

    /// Place of a facet's white; its black is the next.
    pub fn level(&self, facet: usize) -> Option<usize> {
        self.levels[facet]
    }

    /// Place of the slope of a facet's light along its x axis; that along y is the next.
    pub fn slope(&self, facet: usize) -> Option<usize> {
        // Levels come in pairs too, in the same order.
        Some(self.even + (self.levels[facet]? - COMMON))
    }

    pub fn seam(&self, seam: usize) -> Option<usize> {
        self.seams[seam]
    }

    /// The facets that have a place, with it.
    pub fn facets(&self) -> impl Iterator<Item = (usize, usize)> {
        self.levels.iter().enumerate().filter_map(|(facet, at)| Some((facet, (*at)?)))
    }

    fn seams(&self) -> impl Iterator<Item = (usize, usize)> {
        self.seams.iter().enumerate().filter_map(|(seam, at)| Some((seam, (*at)?)))
    }
}

/// Adds what is expected without looking: the lens's point spread, black that is a small share of
/// white, light that is much the same all over a facet, seams that are hardly there.
pub(super) fn add_priors(
    normal: &mut DMatrix<f64>,
    right: &mut DVector<f64>,
    state: &State,
    layout: &Layout,
    settings: &Settings,
) {
    // The samples count as fewer; so that priors keep their weight among them, it grows.
    let share = settings.samples_per_pixel();
    let expected = settings.blur_px.powi(2);
    let precision = share / settings.blur_variance_px2.powi(2);
    for (k, wanted, is) in [
        (6, expected, state.blur[(0, 0)]),
        (7, 0.0, state.blur[(0, 1)]),
        (8, expected, state.blur[(1, 1)]),
    ] {
        normal[(k, k)] += precision;
        right[k] += precision * (wanted - is);
    }
    let (wanted, spread) = CODED_BLUR_PX2;
    let scale = settings.magnification.powi(2);
    let precision = share / (spread * scale).powi(2);
    normal[(CODED, CODED)] += precision;
    right[CODED] += precision * (wanted * scale - state.coded_blur);
    let (black, spread) = BLACK_SHARE;
    let mut brightest: f64 = 0.01;
    for (facet, at) in layout.facets() {
        let [w, b] = state.levels[facet];
        brightest = brightest.max(w);
        let precision = share / (spread * w.abs().max(0.01)).powi(2);
        // The row b - black w = 0.
        let residual = black * w - b;
        normal[(at, at)] += precision * black * black + 1e-6;
        normal[(at + 1, at + 1)] += precision + 1e-6;
        normal[(at, at + 1)] -= precision * black;
        normal[(at + 1, at)] -= precision * black;
        right[at] -= precision * black * residual;
        right[at + 1] += precision * residual;
        if let Some(at) = layout.slope(facet) {
            normal[(at, at)] += share / SLOPE_PER_M.powi(2);
            normal[(at + 1, at + 1)] += share / SLOPE_PER_M.powi(2);
        }
    }
    for (seam, at) in layout.seams() {
        let precision = share / (SEAM_M * brightest).powi(2);
        normal[(at, at)] += precision;
        right[at] -= precision * state.seams[seam];
    }
}

/// Takes a step, or the part of it that is not too long, without its slopes, if it has some; returns how
/// far the body moved in the patch, pixels. `None` for a step that is not a number.
pub(super) fn take(
    state: &mut State,
    step: &DVector<f64>,
    layout: &Layout,
    patch: &Patch,
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
    let across = (shift - sight * along).norm() / position.norm() * patch.pinhole.focal_px;
    let largest = (turn.norm() / 0.1).max(across / 2.0).max(along.abs() / position.norm() / 0.05);
    let share = 1.0 / largest.max(1.0);
    state.patch_from_markers = Isometry3::from_parts(
        Translation3::from(position + shift * share),
        UnitQuaternion::from_scaled_axis(turn * share) * pose.rotation,
    );
    state.blur += Matrix2::new(step[6], step[7], step[7], step[8]) * share;
    state.blur = within(&state.blur);
    state.coded_blur += step[CODED] * share;
    for (facet, at) in layout.facets() {
        state.levels[facet][0] += step[at];
        state.levels[facet][1] += step[at + 1];
    }
    for (seam, at) in layout.seams() {
        state.seams[seam] += step[at];
    }
    let turned = turn.norm() * 0.08 / position.norm() * patch.pinhole.focal_px;
    let nearer = along.abs() / position.norm() * 0.08 / position.norm() * patch.pinhole.focal_px;
    Some(across.max(turned).max(nearer) * share)
}

/// The nearest point spread that can be.
fn within(blur: &Matrix2<f64>) -> Matrix2<f64> {
    let mut axes = blur.symmetric_eigen();
    for value in axes.eigenvalues.iter_mut() {
        *value = value.clamp(BLUR_PX.0.powi(2), BLUR_PX.1.powi(2));
    }
    axes.recompose()
}
