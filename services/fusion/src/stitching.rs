//! The lenses of a stitched camera: from the configuration, or from bodies across their border.

use std::collections::BTreeMap;
use std::fmt;

use flockeye_contract::ViewHeader;
use flockeye_geometry::camera::{Half, ShownBy, Stitch};
use flockeye_geometry::pose::{CornerRay, PoseEstimate};
use flockeye_imaging::align::SeenStitch;
use nalgebra::{Matrix5, Vector5};

use crate::parallax::predicted_distance_m;

/// Deviations of the constants of a camera that nobody states (see [`Stitch::new`]): half the distance
/// of the lenses (m), the halves' shift at the border, half their turn (rad). Cameras with lenses back
/// to back have them 15 to 25 mm apart, stitch for a metre or more, and turn them by a tenth of a
/// degree or two.
const UNKNOWN: [f64; 3] = [0.006, 0.003, 0.001];
/// Deviation of half the distance where the configuration states it, metres.
const STATED_M: f64 = 0.0005;
/// Deviations of what a body shows at one place, because lenses have errors of their own there.
const OF_PLACE: [f64; 3] = [0.0003, 0.0003, 0.0002];
/// Deviations that stay, however many places were seen: the errors of lenses are alike nearby.
const LEFT: [f64; 3] = [0.00015, 0.00015, 0.0001];
/// Number of measurements in a row that contradict the estimate, after which it begins anew.
const CONTRADICTIONS: u32 = 30;
/// Weight below which a measurement contradicts the estimate.
const CONTRADICTING: f64 = 0.2;
/// Squared distance from the estimate, in deviations, from which on a measurement counts less: that of
/// one in a thousand.
const USUAL: f64 = 20.5;
/// Changes of the constants (as in [`UNKNOWN`]) by which the poses of tracks are corrected.
const MOVED: [f64; 3] = [0.0002, 0.0002, 0.0001];
/// Deviation of half the distance below which it is known, metres.
const KNOWN_M: f64 = 0.001;

/// What is known of the camera's lenses, and of the views.
#[derive(Debug, Clone)]
pub(crate) struct StitchEstimate {
    /// What is known before the first body.
    assumed: Stitch,
    /// Lens distance with which views are made exact for their distances, metres.
    of_views_m: f64,
    /// Distance for which a view is exact without a prediction, metres.
    assumed_m: f64,
    /// Information of the bodies about the constants, and that times the constants.
    learned: (Matrix5<f64>, Vector5<f64>),
    /// The estimate from both.
    current: Stitch,
    /// Seen in the open frame by target, so that the result does not depend on the order.
    pending: BTreeMap<usize, SeenStitch>,
    /// Number of measurements in a row that contradict the estimate.
    contradictions: u32,
    /// The estimate by which the poses of tracks were corrected last.
    of_tracks: Stitch,
}

impl StitchEstimate {
    /// The estimate before the first frame. `stated_m` is the configured distance of the lenses.
    pub(crate) fn new(stated_m: Option<f64>, assumed_m: f64) -> Self {
        let [distance, shift, turn] = UNKNOWN;
        let half_m = stated_m.unwrap_or(0.0) / 2.0;
        let distance = if stated_m.is_some() { STATED_M } else { distance };
        let assumed = Stitch::new(half_m, [distance, shift, turn]);
        Self {
            assumed,
            of_views_m: 2.0 * half_m,
            assumed_m,
            learned: (Matrix5::zeros(), Vector5::zeros()),
            current: assumed,
            pending: BTreeMap::new(),
            contradictions: 0,
            of_tracks: assumed,
        }
    }

    /// The lenses of a camera that is exactly as configured.
    pub(crate) fn exact(lens_distance_m: f64, assumed_m: f64) -> Self {
        let exact = Stitch::new(lens_distance_m / 2.0, [0.0; 3]);
        let new = Self::new(Some(lens_distance_m), assumed_m);
        Self { assumed: exact, current: exact, of_tracks: exact, ..new }
    }

    /// Whether the constants are known exactly, so that nothing is learned.
    fn is_exact(&self) -> bool {
        self.assumed.covariance().trace() == 0.0
    }

    /// The camera of a view, as its pixels show it.
    pub(crate) fn of_view(&self, view: Option<&ViewHeader>) -> Stitch {
        let exact_m = view.and_then(predicted_distance_m).unwrap_or(self.assumed_m);
        self.current.seen_at(self.of_views_m, exact_m)
    }

    /// The camera whose rays were made exact for their distance.
    pub(crate) fn current(&self) -> &Stitch {
        &self.current
    }

    /// Distance for which rays are made exact where nothing is predicted, metres.
    pub(crate) fn assumed_m(&self) -> f64 {
        self.assumed_m
    }

    /// Adds what a body shows in the open frame.
    pub(crate) fn note(&mut self, target: usize, seen: SeenStitch) {
        self.pending.insert(target, seen);
    }

    /// Ends a frame. If the poses of tracks are to be corrected ([`remade`]), returns the estimate by
    /// which they were made.
    pub(crate) fn end_frame(&mut self) -> Option<Stitch> {
        let pending = std::mem::take(&mut self.pending);
        if pending.is_empty() || self.is_exact() {
            return None;
        }
        for seen in pending.into_values() {
            let Some(SeenStitch { information, moment }) = with_place(&seen) else { continue };
            let share = self.share_of(&information, &moment);
            self.contradictions = if share < CONTRADICTING { self.contradictions + 1 } else { 0 };
            if self.contradictions >= CONTRADICTIONS {
                self.learned = (Matrix5::zeros(), Vector5::zeros());
                self.contradictions = 0;
            }
            let (sum, of_moment) = &mut self.learned;
            *sum += information * share;
            *of_moment += moment * share;
        }
        self.update();
        let moved = self.current.constants() - self.of_tracks.constants();
        let limits = Stitch::new(0.0, MOVED).covariance().diagonal();
        let has_moved = moved.iter().zip(&limits).any(|(moved, limit)| moved.powi(2) > *limit);
        has_moved.then(|| std::mem::replace(&mut self.of_tracks, self.current))
    }

    /// Weight of a measurement: less than 1 for one that is farther from the estimate than others.
    fn share_of(&self, information: &Matrix5<f64>, moment: &Vector5<f64>) -> f64 {
        let off = moment - information * self.current.constants();
        let expected = information + information * self.current.covariance() * information;
        let axes = expected.symmetric_eigen();
        let least = axes.eigenvalues.max() * 1e-9;
        let distance: f64 = axes
            .eigenvalues
            .iter()
            .zip(axes.eigenvectors.column_iter())
            .filter(|(variance, _)| **variance > least)
            .map(|(variance, axis)| axis.dot(&off).powi(2) / variance)
            .sum();
        (USUAL / distance.max(USUAL)).clamp(0.0, 1.0)
    }

    fn update(&mut self) {
        let before = self.assumed.covariance().cholesky().map(|it| it.inverse());
        let Some(before) = before else { return };
        let Some(both) = (before + self.learned.0).cholesky() else { return };
        let constants = both.solve(&(before * self.assumed.constants() + self.learned.1));
        let has_learned = self.learned.0.trace() > 0.0;
        let left = *Stitch::new(0.0, if has_learned { LEFT } else { [0.0; 3] }).covariance();
        if let Some(current) = Stitch::of(constants, both.inverse() + left) {
            self.current = current;
        }
    }

    /// What was learned, for the next process: the information, and the moment.
    pub(crate) fn learned(&self) -> (Matrix5<f64>, Vector5<f64>) {
        self.learned
    }

    /// Continues from what another process has learned.
    pub(crate) fn resume(&mut self, learned: (Matrix5<f64>, Vector5<f64>)) {
        let is_sound = learned.0.iter().chain(learned.1.iter()).all(|it| it.is_finite());
        if is_sound && !self.is_exact() {
            self.learned = learned;
            self.update();
            self.of_tracks = self.current;
        }
    }
}

/// A pose that was measured while the camera was thought to be `before`, as the camera `now` makes it.
/// A body of `radius_m` on the border of the halves, which both show, stays where it is.
pub(crate) fn remade(
    pose: &PoseEstimate,
    radius_m: f64,
    before: &Stitch,
    now: &Stitch,
) -> PoseEstimate {
    let place = pose.camera_from_markers.translation.vector;
    let ShownBy::One(half) = ShownBy::of(&place, radius_m) else { return *pose };
    // `before` may be the camera of a view: only its constants count.
    let before = now.changed(&(before.constants() - now.constants()));
    let shown = before.shown_from_camera(half, &place) * pose.camera_from_markers;
    let camera_from_markers = now.shown_from_camera(half, &place).inverse() * shown;
    PoseEstimate { camera_from_markers, ..*pose }
}

/// A measurement with the errors of its place. `None` for numbers that no picture gives.
fn with_place(seen: &SeenStitch) -> Option<SeenStitch> {
    let of_place = *Stitch::new(0.0, OF_PLACE).covariance();
    let share = (Matrix5::identity() + seen.information * of_place).try_inverse()?;
    let information = share * seen.information;
    let information = (information + information.transpose()) / 2.0;
    Some(SeenStitch { information, moment: share * seen.moment })
}

/// Corrects rays of a body's corners, each with the camera of its view, to `metres` from the middle.
/// If the body lies across the border, each ray has what is not known of the halves; else that is
/// one error of the whole body, which is added where poses leave.
pub(crate) fn correct_rays(rays: &mut [CornerRay], cameras: &[Stitch], metres: f64) {
    let halves = rays.iter().map(|ray| Half::unmixed(&ray.ray_in_camera));
    let mut others = halves.clone().skip(1);
    let first = halves.clone().next().flatten();
    let is_whole = first.is_some() && others.all(|half| half == first);
    for (ray, camera) in rays.iter_mut().zip(cameras) {
        let (corrected, deviation) = camera.ray(&ray.ray_in_camera, metres);
        ray.ray_in_camera = corrected;
        if !is_whole {
            ray.deviation_rad = ray.deviation_rad.hypot(deviation);
        }
    }
}

/// The distance of the lenses, and where it comes from, for health.
impl fmt::Display for StitchEstimate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let distance_mm = self.current.lens_distance_m() * 1e3;
        let deviation_m = self.current.covariance()[(0, 0)].max(0.0).sqrt();
        let is_learned = self.learned.0.trace() > 0.0 && deviation_m < KNOWN_M;
        if self.is_exact() {
            return write!(f, "lenses: {distance_mm:.1} mm apart, as the source has them");
        }
        match (is_learned, self.of_views_m > 0.0) {
            (true, _) => {
                let deviation_mm = 2.0 * deviation_m * 1e3;
                write!(f, "lenses: {distance_mm:.1} +- {deviation_mm:.1} mm apart, learned")
            }
            (false, true) => write!(f, "lenses: {distance_mm:.1} mm apart, configured"),
            (false, false) => write!(f, "lenses: not known yet"),
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use nalgebra::{Matrix6, Point3, Translation3, Vector3};

    use super::*;

    /// What a body at a place on the border shows of these constants.
    fn seen(constants: &Vector5<f64>, place: &Vector3<f64>) -> SeenStitch {
        let by = Stitch::by_constants(place);
        let information = by.transpose() * by * 2e-4f64.powi(-2);
        SeenStitch { information, moment: information * constants }
    }

    fn place(turn: f64, range_m: f64) -> Vector3<f64> {
        Vector3::new(0.0, turn.cos(), turn.sin()) * range_m
    }

    const TRUTH: Vector5<f64> = Vector5::new(0.008, 0.0027, 0.0009, -0.0004, 0.0002);

    #[test]
    fn lenses_are_learned_from_bodies_across_their_border() {
        let mut estimate = StitchEstimate::new(None, 1.5);
        assert_eq!(estimate.to_string(), "lenses: not known yet");
        let (far, near) = (place(1.0, 2.0), place(0.2, 0.6));
        let before = estimate.current().extent_rad(&far).1;
        estimate.note(0, seen(&TRUTH, &near));
        estimate.end_frame();
        let after = estimate.current().extent_rad(&far).1;
        assert!(after < 0.7 * before && after > 1e-4, "{before} {after}");
        for k in 0..20 {
            let turn = f64::from(k) * 0.3;
            estimate.note(k as usize % 2, seen(&TRUTH, &place(turn, 0.6 + 0.1 * f64::from(k))));
            estimate.end_frame();
        }
        let off = estimate.current().constants() - TRUTH;
        assert!(off[0].abs() < 5e-4 && off.norm() < 8e-4, "{off}");
        assert!(estimate.to_string().contains("mm apart, learned"), "{estimate}");
        let mut next = StitchEstimate::new(None, 1.5);
        next.resume(estimate.learned());
        assert_eq!(next.current(), estimate.current());
        next.resume((Matrix5::repeat(f64::NAN), Vector5::zeros()));
        assert_eq!(next.current(), estimate.current());
    }

    #[test]
    fn one_wrong_measurement_hardly_counts_and_many_do() {
        let mut estimate = StitchEstimate::new(None, 1.5);
        for k in 0..30 {
            estimate.note(0, seen(&TRUTH, &place(f64::from(k), 0.8)));
            estimate.end_frame();
        }
        let there = place(0.5, 0.8);
        let right = estimate.current().disparity(&there);
        let wrong = Vector5::new(0.02, 0.0, 0.0, 0.0, 0.0);
        estimate.note(0, seen(&wrong, &there));
        estimate.end_frame();
        let moved = (estimate.current().disparity(&there) - right).norm();
        assert!(moved < 5e-4, "{moved}");
        for k in 0..60 {
            estimate.note(0, seen(&wrong, &place(f64::from(k), 0.8)));
            estimate.end_frame();
        }
        let stitch = Stitch::of(wrong, Matrix5::zeros()).unwrap();
        let off = estimate.current().disparity(&there) - stitch.disparity(&there);
        assert!(off.norm() < 1e-3, "{off}");
    }

    /// Poses of one half move with the constants, whatever view showed them; on the border they stay.
    #[test]
    fn poses_are_remade_for_what_is_known_now() {
        let [before, now] = [Vector5::zeros(), TRUTH]
            .map(|constants| Stitch::of(constants, Matrix5::zeros()).unwrap());
        let there = Vector3::new(0.5, 0.6, 0.2);
        let seen = now.shown_from_camera(Half::Ahead, &there);
        let at = |place: Vector3<f64>| PoseEstimate {
            camera_from_markers: Translation3::from(place).into(),
            covariance: Matrix6::identity(),
        };
        let shown = (seen * Point3::from(there)).coords;
        for before in [before, before.seen_at(0.02, 0.7)] {
            let remade = remade(&at(shown), 0.08, &before, &now).camera_from_markers;
            // The turn is about the place where the body seemed to be.
            assert!((remade.translation.vector - there).norm() < 1e-4, "{remade}");
            assert!((shown - there).norm() > 5e-3);
        }
        let border = at(Vector3::new(0.01, 0.8, 0.0));
        assert_eq!(remade(&border, 0.08, &before, &now), border);
    }

    #[test]
    fn a_stated_distance_is_that_of_the_views() {
        let stated = StitchEstimate::new(Some(0.016), 1.5);
        let at_assumed = stated.of_view(None);
        assert!(at_assumed.disparity(&place(0.0, 1.5)).norm() < 1e-12);
        assert!(stated.current().disparity(&place(0.0, 1.5)).norm() > 0.005);
        assert_eq!(stated.to_string(), "lenses: 16.0 mm apart, configured");
    }

    #[test]
    fn a_stated_distance_is_corrected_in_the_cameras_own_frame() {
        let mut estimate = StitchEstimate::new(Some(0.016), 1.5);
        for k in 0..40 {
            let there = place(f64::from(k) * 0.3, 0.6 + 0.02 * f64::from(k));
            let by = Stitch::by_constants(&there);
            // What an alignment in a view for this distance says.
            let of_view = estimate.current().seen_at(0.016, there.norm());
            let information = by.transpose() * by * 2e-4f64.powi(-2);
            let moment =
                information * (TRUTH - of_view.constants()) + information * of_view.constants();
            estimate.note(0, SeenStitch { information, moment });
            estimate.end_frame();
        }
        let off = estimate.current().disparity(&place(1.0, 0.8))
            - Stitch::of(TRUTH, Matrix5::zeros()).unwrap().disparity(&place(1.0, 0.8));
        assert!(off.norm() < 2e-4, "{off}");
        let exact = StitchEstimate::exact(0.016, 1.5);
        assert_eq!(exact.current().covariance().norm(), 0.0);
        assert!(exact.to_string().contains("as the source has them"));
    }

    #[test]
    fn corners_of_one_half_have_one_error_and_those_of_two_have_their_own() {
        let camera = Stitch::new(0.0, [0.006, 0.003, 0.001]);
        let ray = |x: f64| CornerRay {
            marker_id: 0,
            corner: 0,
            ray_in_camera: flockeye_geometry::Ray::new_normalize(Vector3::new(x, 1.0, 0.1)),
            deviation_rad: 1e-4,
        };
        let mut whole = [ray(0.2), ray(0.3)];
        correct_rays(&mut whole, &[camera; 2], 0.8);
        assert_eq!(whole, [ray(0.2), ray(0.3)]);
        let mut across = [ray(-0.1), ray(0.1)];
        correct_rays(&mut across, &[camera; 2], 0.8);
        assert!(across.iter().all(|ray| ray.deviation_rad > 0.005), "{across:?}");
    }
}
