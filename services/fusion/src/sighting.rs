//! One believed pose of a body from a frame's rays.

use flockeye_contract::DetectedMarker;
use flockeye_geometry::Ray;
use flockeye_geometry::body::Body;
use flockeye_geometry::pose::{CornerRay, PoseOptions, PosePrior, PoseSolution, choose, solve};
use flockeye_geometry::view::{View, ViewPixel};
use nalgebra::{Unit, Vector2, Vector3};

use crate::neighbour::PoseEstimate;

/// Markers that must agree on a pose before it is believed without a track to compare it with: one
/// marker alone may be a misread square, and its mirror image cannot be told from it.
pub const MARKERS_ALONE: usize = 2;

/// A body farther than this cannot carry a marker that decodes, metres.
const FARTHEST_M: f64 = 50.0;

/// A pose of a body that the frame shows.
#[derive(Debug, Clone, PartialEq)]
pub struct Sighting {
    /// The solution.
    pub solution: PoseSolution,
    /// The pose it gives.
    pub pose: PoseEstimate,
    /// Markers of the body that were decoded.
    pub markers: u32,
}

/// Rays of those of `markers` that were decoded and that `body` carries.
pub fn rays_of<'m>(
    body: &Body,
    markers: impl IntoIterator<Item = &'m DetectedMarker>,
) -> Vec<CornerRay> {
    let own = markers
        .into_iter()
        .filter(|marker| marker.is_decoded() && body.marker(marker.id).is_some());
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

/// The pose of `body` that explains `rays`, chosen with the track's prediction where there is one.
///
/// Without a prediction at least [`MARKERS_ALONE`] markers must agree.
pub fn sight(body: &Body, rays: &[CornerRay], prior: Option<&PosePrior>) -> Option<Sighting> {
    let solutions = solve(body, rays, &PoseOptions::default()).ok()?;
    let choice = choose(&solutions, prior)?;
    let solution = choice.solution.clone();
    let needed = if prior.is_some() { 1 } else { MARKERS_ALONE };
    let range = solution.camera_from_markers.translation.vector.norm();
    let is_believed = solution.inlier_markers.len() >= needed && range < FARTHEST_M;
    let markers = distinct_markers(rays);
    let pose = PoseEstimate {
        camera_from_markers: solution.camera_from_markers,
        covariance: solution.inflated_covariance(),
    };
    is_believed.then_some(Sighting { solution, pose, markers })
}

fn distinct_markers(rays: &[CornerRay]) -> u32 {
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
    use flockeye_geometry::body::squares;
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

    #[test]
    fn two_markers_are_believed_and_one_only_with_a_track() {
        let body = squares("alpha", 0.0625, 0.05, 0);
        let pose = Isometry3::from_parts(
            Translation3::new(-0.7, 0.5, 0.3),
            UnitQuaternion::from_euler_angles(0.2, 0.1, 0.7),
        );
        let rays = rays_of(&body, &seen(&body, &pose, 8));
        let sighting = sight(&body, &rays, None).expect("several markers agree");
        assert!(
            (sighting.solution.camera_from_markers.translation.vector - pose.translation.vector)
                .norm()
                < 1e-6
        );
        assert!(sighting.markers >= 2);
        let rays = rays_of(&body, &seen(&body, &pose, 1));
        assert_eq!(sight(&body, &rays, None), None);
        let prior = PosePrior {
            camera_from_markers: pose,
            covariance: nalgebra::Matrix6::identity() * 1e-4,
        };
        let sighting = sight(&body, &rays, Some(&prior)).expect("the track decides");
        assert!(
            (sighting.solution.camera_from_markers.translation.vector - pose.translation.vector)
                .norm()
                < 1e-3
        );
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
