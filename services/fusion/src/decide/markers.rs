//! Whether decoded markers support or contradict a pose.

use flockeye_geometry::body::Body;
use flockeye_geometry::pose::CornerRay;
use nalgebra::{Isometry3, Unit};

/// A corner contradicts a pose that has it elsewhere by more than this share of its marker's side.
/// A mirror pose, or a body turned by one facet, has corners farther off; a right pose never has.
const CONTRADICTION_SIDES: f64 = 0.25;

/// A corner supports a pose that has it within this share of its marker's side. A tilt or a range
/// that is off by a tenth moves corners farther.
const SUPPORT_SIDES: f64 = 0.04;

/// Whether most corners lie elsewhere than `pose` has them.
pub(crate) fn contradicts(body: &Body, rays: &[CornerRay], pose: &Isometry3<f64>) -> bool {
    let is_elsewhere = |ray: &&CornerRay| {
        offset_in_sides(body, ray, pose).is_some_and(|offset| offset > CONTRADICTION_SIDES)
    };
    2 * rays.iter().filter(is_elsewhere).count() > rays.len()
}

/// Whether there are corners, and all of them lie where `pose` has them.
pub(crate) fn supports(body: &Body, rays: &[CornerRay], pose: &Isometry3<f64>) -> bool {
    let is_near = |ray: &CornerRay| {
        offset_in_sides(body, ray, pose).is_some_and(|offset| offset < SUPPORT_SIDES)
    };
    !rays.is_empty() && rays.iter().all(is_near)
}

/// The angle between a corner's ray and where `pose` has that corner, in sides of its marker.
/// `None` for a marker that `body` does not carry.
fn offset_in_sides(body: &Body, ray: &CornerRay, pose: &Isometry3<f64>) -> Option<f64> {
    let marker = body.marker(ray.marker_id)?;
    let corner = pose * marker.corners[ray.corner];
    let side_rad = marker.side() / corner.coords.norm();
    Some(Unit::new_normalize(corner.coords).angle(&ray.ray_in_camera) / side_rad)
}
