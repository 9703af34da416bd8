//! One believed pose of a body from a frame's rays and pixels.

use flockeye_contract::DetectedMarker;
use flockeye_geometry::Ray;
use flockeye_geometry::body::Body;
use flockeye_geometry::pose::{CornerRay, PoseOptions, PosePrior, PoseSolution, choose, solve};
use flockeye_geometry::view::{View, ViewPixel};
use flockeye_imaging::align::{Alignment, Picture};
use nalgebra::{Isometry3, Unit, Vector2, Vector3};

use crate::alignment::{Aligner, BestView, Pace, Start};
use crate::neighbour::PoseEstimate;

/// Markers that must agree on a pose before it is believed without a track to compare it with: one
/// marker alone may be a misread square, and its mirror image cannot be told from it.
pub const MARKERS_ALONE: usize = 2;

/// A body farther than this cannot carry a marker that decodes, metres.
const FARTHEST_M: f64 = 50.0;
/// A pose from corners that is less certain than this, in all its axes together, is none: of 29 that
/// said 40 to 60 mm on simulated flights the worst was off by 94.
const MAX_POSITION_DEVIATION_M: f64 = 0.05;
const MAX_ROTATION_DEVIATION_RAD: f64 = 0.08;

/// How a pose was measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MeasuredBy {
    /// From the corners of decoded markers.
    Decoded,
    /// By the whole body's alignment with the image.
    Aligned,
}

/// A pose of a body that the frame shows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sighting {
    /// The pose.
    pub pose: PoseEstimate,
    /// What it was measured by.
    pub measured_by: MeasuredBy,
    /// Markers of the body that were decoded.
    pub markers: u32,
}

impl Sighting {
    /// What alignment found, with so many markers decoded.
    pub fn aligned(found: &Alignment, markers: u32) -> Self {
        let pose = PoseEstimate {
            camera_from_markers: found.camera_from_markers,
            covariance: found.covariance,
        };
        Self { pose, measured_by: MeasuredBy::Aligned, markers }
    }
}

/// Whether most corners are seen elsewhere than `pose` has them: by a quarter of their marker's side.
/// A mirror image, or a body one facet further, has them farther off; a right pose never.
pub fn contradicts(body: &Body, rays: &[CornerRay], pose: &Isometry3<f64>) -> bool {
    let off = rays.iter().filter(|ray| off_in_sides(body, ray, pose).is_some_and(|off| off > 0.25));
    2 * off.count() > rays.len()
}

/// Whether all corners are seen where `pose` has them, by a twenty-fifth of their marker's side: a tilt
/// or a range that is off by a tenth moves them farther.
pub fn is_where_seen(body: &Body, rays: &[CornerRay], pose: &Isometry3<f64>) -> bool {
    let is_near = |ray: &CornerRay| off_in_sides(body, ray, pose).is_some_and(|off| off < 0.04);
    !rays.is_empty() && rays.iter().all(is_near)
}

/// How far from where `pose` has it a corner is seen, in sides of its marker; `None` if it is no marker
/// of `body`.
fn off_in_sides(body: &Body, ray: &CornerRay, pose: &Isometry3<f64>) -> Option<f64> {
    let marker = body.marker(ray.marker_id)?;
    let corner = pose * marker.corners[ray.corner];
    let side_rad = marker.side() / corner.coords.norm();
    Some(Unit::new_normalize(corner.coords).angle(&ray.ray_in_camera) / side_rad)
}

/// Rays of those of `markers` that were decoded and that `body` carries.
pub fn rays_of<'m>(
    body: &Body,
    markers: impl IntoIterator<Item = &'m DetectedMarker>,
) -> Vec<CornerRay> {
    own_rays(body, markers.into_iter().filter(|marker| marker.is_decoded()))
}

/// Rays of those that are only probably markers of `body`.
pub fn doubtful_rays_of<'m>(
    body: &Body,
    markers: impl IntoIterator<Item = &'m DetectedMarker>,
) -> Vec<CornerRay> {
    own_rays(body, markers.into_iter().filter(|marker| !marker.is_decoded()))
}

fn own_rays<'m>(body: &Body, markers: impl Iterator<Item = &'m DetectedMarker>) -> Vec<CornerRay> {
    let own = markers.filter(|marker| body.marker(marker.id).is_some());
    own.flat_map(|marker| {
        (0..4).map(|corner| CornerRay {
            marker_id: marker.id,
            corner,
            ray_in_camera: ray(marker.rays_in_camera[corner]),
            deviation_rad: marker.deviations[corner],
        })
    })
    .collect()
}

fn ray(components: [f64; 3]) -> Ray {
    Unit::new_normalize(Vector3::from(components))
}

/// What there is to measure a body by in a frame.
pub struct Look<'l> {
    /// The body's number...
    pub target: usize,
    /// ...and the body.
    pub body: &'l Body,
    /// Rays of its decoded markers' corners.
    pub rays: Vec<CornerRay>,
    /// Rays of squares that are probably its markers: to begin an alignment from, and for nothing else.
    pub doubtful: Vec<CornerRay>,
    /// The distance that the rays are right for, metres; infinite where it does not matter.
    pub rays_m: f64,
    /// Its track's prediction, once it is believed.
    pub prior: Option<PosePrior>,
    /// Its track's prediction, believed or not.
    pub predicted: Option<Isometry3<f64>>,
    /// The best view of it.
    pub best_view: Option<BestView<'l>>,
    /// Whether it may be searched for round its prediction where nothing else finds it: that takes
    /// several times as long.
    pub may_search: bool,
    /// How much time there is.
    pub pace: Pace,
    /// Decoded markers that must agree where nothing is aligned, with a prior.
    pub needed: usize,
    /// What alignment began from in this frame when it last led nowhere.
    pub tried: Option<Basis>,
    /// What was tried before the view was searched for markers.
    pub peek: Option<&'l Peek>,
    /// Whether what takes long is left to a second look.
    pub has_second: bool,
    /// What a second look at this frame began from, if there was one.
    pub second: Option<Basis>,
}

/// An alignment from a prediction alone, and what it led to, whether that is the body or not.
#[derive(Debug, Clone)]
pub struct Peek {
    /// The prediction, `camera_from_markers`.
    pub predicted: Isometry3<f64>,
    /// The view.
    pub view_index: u32,
    /// Where it led.
    pub found: Option<Box<Alignment>>,
}

/// What of a frame a body's alignment begins from, beside its prediction. Where it led nowhere once, it
/// does so again.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Basis {
    view_index: Option<u32>,
    /// How many rays there are: a frame's records only add to them.
    rays: usize,
    doubtful: usize,
    pace: Pace,
}

impl Basis {
    /// Whether looking by this finds nothing new where looking by `other` was in vain. Who is behind tries
    /// only the first of what it begins from.
    fn adds_nothing_to(&self, other: &Self) -> bool {
        (Self { pace: other.pace, ..*self } == *other)
            && (self.pace == other.pace || self.pace == Pace::Behind)
    }
}

/// Solutions from corners that alignment begins from, cheapest first: the right one may be dearer
/// than its mirror image.
const STARTS_FROM_CORNERS: usize = 3;

impl Look<'_> {
    /// What alignment begins from.
    pub fn basis(&self) -> Basis {
        Basis {
            view_index: self.best_view.map(|view| view.view_index),
            rays: self.rays.len(),
            doubtful: self.doubtful.len(),
            pace: self.pace,
        }
    }

    /// Whether a basis, given what was tried, is worth another look.
    fn is_new(&self, basis: impl Fn(&Basis) -> Basis) -> bool {
        self.tried.is_none_or(|tried| !basis(&tried).adds_nothing_to(&tried))
    }

    /// The pose that alignment finds, from the corners' solutions or from the prediction; where it
    /// finds none, that from corners.
    pub fn measure(&self, aligner: &Aligner) -> Option<Sighting> {
        let solutions = solve(self.body, &self.rays, &PoseOptions::default()).unwrap_or_default();
        let chosen = choose(&solutions, self.prior.as_ref()).map(|choice| choice.solution);
        let markers = distinct_markers(&self.rays);
        if let Some(BestView { picture, .. }) = &self.best_view {
            let found = self.align(aligner, picture, &solutions, chosen).or_else(|| {
                let is_last_look = !self.has_second;
                let predicted = self.predicted.filter(|_| self.may_search && is_last_look)?;
                aligner.reacquire(self.target, picture, &predicted)
            });
            if let Some(found) = found {
                return Some(Sighting::aligned(&found, markers));
            }
        }
        let solution = chosen?;
        let needed = if self.prior.is_some() { self.needed } else { MARKERS_ALONE };
        let range = solution.camera_from_markers.translation.vector.norm();
        let covariance = solution.inflated_covariance();
        let deviation = |first| covariance.fixed_view::<3, 3>(first, first).trace().sqrt();
        let is_believed = solution.inlier_markers.len() >= needed
            && range < FARTHEST_M
            && deviation(0) < MAX_POSITION_DEVIATION_M
            && deviation(3) < MAX_ROTATION_DEVIATION_RAD;
        let pose = PoseEstimate { camera_from_markers: solution.camera_from_markers, covariance };
        is_believed.then_some(Sighting { pose, measured_by: MeasuredBy::Decoded, markers })
    }

    /// The body aligned from the corners' solutions, the `chosen` one first, from doubtful squares or from
    /// the prediction; but not again from what led nowhere. Rough starts are left to a second look where
    /// there is one.
    fn align(
        &self,
        aligner: &Aligner,
        picture: &Picture<'_>,
        solutions: &[PoseSolution],
        chosen: Option<&PoseSolution>,
    ) -> Option<Alignment> {
        let basis = self.basis();
        let mut starts: Vec<Start> = Vec::new();
        let fine_is_new = self.is_new(|tried| Basis { doubtful: tried.doubtful, ..basis });
        let rough_is_new = self.is_new(|_| basis);
        if fine_is_new {
            let others = solutions.iter().filter(|solution| Some(*solution) != chosen);
            let from_corners = chosen.into_iter().chain(others).take(STARTS_FROM_CORNERS);
            starts.extend(from_corners.map(|solution| Start::Fine(solution.camera_from_markers)));
        }
        let is_rough_too = !self.has_second;
        if is_rough_too && rough_is_new {
            starts.extend(self.doubtful_starts());
        }
        if fine_is_new && let Some(predicted) = self.predicted {
            starts.push(self.peeked(&predicted).unwrap_or(Start::Fine(predicted)));
            starts.extend(is_rough_too.then_some(Start::Rough(predicted)));
        }
        let is_marked = |pose: &Isometry3<f64>| is_where_seen(self.body, &self.rays, pose);
        match &self.prior {
            Some(prior) => {
                let predicted = &prior.camera_from_markers;
                aligner.follow(self.target, picture, &starts, predicted, self.pace, is_marked)
            }
            None => aligner
                .discover(self.target, picture, &starts, self.pace, is_marked)
                // What only one facet says of a newcomer is weighed against all other starts.
                .filter(|found| {
                    !self.has_second || self.predicted.is_some() || found.evidence.is_unambiguous()
                }),
        }
    }

    fn doubtful_starts(&self) -> impl Iterator<Item = Start> {
        let solutions = solve(self.body, &self.doubtful, &PoseOptions::default());
        let solutions = solutions.unwrap_or_default().into_iter().take(STARTS_FROM_CORNERS);
        solutions.map(|solution| Start::Rough(solution.camera_from_markers))
    }

    /// What the same start was seen to lead to in the same view.
    fn peeked(&self, predicted: &Isometry3<f64>) -> Option<Start> {
        let view_index = self.best_view?.view_index;
        let is_same = |peek: &&Peek| peek.view_index == view_index && peek.predicted == *predicted;
        self.peek.filter(is_same).map(|peek| Start::Tried(peek.found.clone()))
    }

    /// Whether a second look has something to begin from that no other of the same frame had.
    pub fn wants_second(&self) -> bool {
        self.has_second
            && (self.pace == Pace::Live || self.prior.is_none())
            && self.second.is_none_or(|second| !self.basis().adds_nothing_to(&second))
    }

    /// What a second look begins from: for a neighbour that is not believed yet from its corners again
    /// too, since what one start leads to is weighed against what the others do.
    pub fn second_starts(&self) -> Vec<Start> {
        let from_corners = match self.prior {
            Some(_) => Vec::new(),
            None => solve(self.body, &self.rays, &PoseOptions::default()).unwrap_or_default(),
        };
        let from_corners = from_corners.into_iter().take(STARTS_FROM_CORNERS);
        from_corners
            .map(|solution| Start::Fine(solution.camera_from_markers))
            .chain(self.doubtful_starts())
            .chain(self.predicted.map(Start::Rough))
            .collect()
    }
}

/// How many markers these are corners of.
pub fn distinct_markers(rays: &[CornerRay]) -> u32 {
    let mut ids: Vec<u32> = rays.iter().map(|ray| ray.marker_id).collect();
    ids.sort_unstable();
    ids.dedup();
    ids.len() as u32
}

/// A foreign stage's rays may differ from ours by rounding, not by more, radians.
const RAY_TOLERANCE_RAD: f64 = 1e-3;

/// Whether a record's rays are those of its corners in the view that was searched.
pub fn agrees_with_view(marker: &DetectedMarker, view: &View) -> bool {
    marker.corners_in_view.iter().zip(&marker.rays_in_camera).all(|(&[u, v], &stated)| {
        let seen = view.ray(ViewPixel(Vector2::new(f64::from(u), f64::from(v))));
        seen.angle(&ray(stated)) < RAY_TOLERANCE_RAD
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockeye_geometry::body::{Bodies, squares};
    use flockeye_imaging::edges::MarkerPrint;
    use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion};

    fn seen(body: &Body, pose: &Isometry3<f64>, most: usize) -> Vec<DetectedMarker> {
        let facing = body.markers.iter().filter(|marker| {
            let towards = pose.inverse_transform_point(&Point3::origin()) - marker.centre();
            marker.normal().dot(&towards.normalize()) > 0.5
        });
        facing
            .take(most)
            .map(|marker| DetectedMarker {
                rays_in_camera: marker.corners.map(|corner| {
                    let ray = (pose * corner).coords.normalize();
                    [ray.x, ray.y, ray.z]
                }),
                deviations: [2e-4; 4],
                id: marker.id,
                ..DetectedMarker::default()
            })
            .collect()
    }

    /// What the corners alone say.
    fn sight(body: &Body, rays: Vec<CornerRay>, prior: Option<PosePrior>) -> Option<Sighting> {
        let bodies = Bodies::new("DICT_5X5_250".into(), vec![body.clone()]).expect("one body");
        let print = MarkerPrint::of_bits(&[true; 25]).expect("five by five");
        let aligner = Aligner::new(&bodies, |_| Some(&print), 611.0).expect("small markers");
        let look = Look {
            target: 0,
            body,
            rays,
            doubtful: Vec::new(),
            rays_m: f64::INFINITY,
            prior,
            predicted: None,
            best_view: None,
            may_search: false,
            pace: Pace::Unhurried,
            needed: 1,
            tried: None,
            peek: None,
            has_second: false,
            second: None,
        };
        look.measure(&aligner)
    }

    fn error_m(sighting: &Sighting, truth: &Isometry3<f64>) -> f64 {
        let found = &sighting.pose.camera_from_markers;
        (found.translation.vector - truth.translation.vector).norm()
    }

    #[test]
    fn two_markers_are_believed_and_one_only_with_a_track() {
        let body = squares("alpha", 0.0625, 0.05, 0);
        let pose = Isometry3::from_parts(
            Translation3::new(-0.7, 0.5, 0.3),
            UnitQuaternion::from_euler_angles(0.2, 0.1, 0.7),
        );
        let sighting =
            sight(&body, rays_of(&body, &seen(&body, &pose, 8)), None).expect("several agree");
        assert!(error_m(&sighting, &pose) < 1e-6);
        assert!(sighting.markers >= 2);
        let rays = rays_of(&body, &seen(&body, &pose, 1));
        assert_eq!(sight(&body, rays.clone(), None), None);
        let covariance = nalgebra::Matrix6::identity() * 1e-4;
        let prior = PosePrior { camera_from_markers: pose, covariance };
        let sighting = sight(&body, rays, Some(prior)).expect("the track decides");
        assert!(error_m(&sighting, &pose) < 1e-3);
    }

    #[test]
    fn markers_of_others_are_left_out() {
        let (alpha, bravo) =
            (squares("alpha", 0.0625, 0.05, 0), squares("bravo", 0.0625, 0.05, 17));
        let pose = Isometry3::translation(1.0, 0.0, 0.0);
        assert!(rays_of(&bravo, &seen(&alpha, &pose, 8)).is_empty());
    }

    #[test]
    fn rays_that_are_not_the_corners_are_noticed() {
        let view = View::looking_at(&Vector3::x_axis(), 1.0, 201);
        let corners = [[90.0f32, 90.0], [110.0, 90.0], [110.0, 110.0], [90.0, 110.0]];
        let mut marker = DetectedMarker {
            corners_in_view: corners,
            rays_in_camera: corners.map(|[u, v]| {
                let ray = view.ray(ViewPixel::new(f64::from(u), f64::from(v)));
                [ray.x, ray.y, ray.z]
            }),
            ..DetectedMarker::default()
        };
        assert!(agrees_with_view(&marker, &view));
        marker.rays_in_camera.swap(0, 2);
        assert!(!agrees_with_view(&marker, &view));
    }
}
