//! Whether decoded markers support or contradict a pose.

use flockeye_geometry::body::Body;
use flockeye_geometry::pose::CornerRay;
use nalgebra::{Isometry3, Unit};

/// Distance of a corner from its place in a pose that contradicts the pose, as a share of its
/// marker's side. A mirror pose, or a body turned by one facet, has larger distances; a right pose
/// never has.
const CONTRADICTION_SIDES: f64 = 0.25;

/// Largest distance of a corner that supports a pose, as a share of its marker's side. An error of
/// a tenth in tilt or range moves corners farther.
const SUPPORT_SIDES: f64 = 0.04;

/// Whether most corners differ from their places in `pose`.
pub(crate) fn contradicts(body: &Body, rays: &[CornerRay], pose: &Isometry3<f64>) -> bool {
    let is_elsewhere = |ray: &&CornerRay| {
        offset_in_sides(body, ray, pose).is_some_and(|offset| offset > CONTRADICTION_SIDES)
    };
    2 * rays.iter().filter(is_elsewhere).count() > rays.len()
}

/// Whether there are corners, and all of them are at their places in `pose`.
pub(crate) fn supports(body: &Body, rays: &[CornerRay], pose: &Isometry3<f64>) -> bool {
    let is_near = |ray: &CornerRay| {
        offset_in_sides(body, ray, pose).is_some_and(|offset| offset < SUPPORT_SIDES)
    };
    !rays.is_empty() && rays.iter().all(is_near)
}

/// Angle between a corner's ray and its place in `pose`, in sides of its marker. `None` for a
/// marker that `body` does not carry.
fn offset_in_sides(body: &Body, ray: &CornerRay, pose: &Isometry3<f64>) -> Option<f64> {
    let marker = body.marker(ray.marker_id)?;
    let corner = pose * marker.corners[ray.corner];
    let side_rad = marker.side() / corner.coords.norm();
    Some(Unit::new_normalize(corner.coords).angle(&ray.ray_in_camera) / side_rad)
}
