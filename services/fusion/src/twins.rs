//! Two bodies that carry the same markers.

use flockeye_contract::DetectedMarker;
use flockeye_geometry::Ray;
use flockeye_geometry::body::Body;
use nalgebra::Vector3;

use crate::measurement::ray;
use crate::notices::Notice;

/// A notice if a frame shows one marker of `body` at two places that are farther apart than the body
/// is wide. Two drones then carry its markers, or something shows a picture of them.
pub(crate) fn seen_twice<'m>(
    body: &Body,
    markers: impl Iterator<Item = &'m DetectedMarker>,
) -> Option<Notice> {
    let is_own = |seen: &&DetectedMarker| body.marker(seen.id).is_some();
    let own: Vec<&DetectedMarker> = markers.filter(is_own).collect();
    let middle = |rays: &[Ray; 4]| rays.iter().map(|ray| ray.into_inner()).sum::<Vector3<f64>>();
    own.iter().enumerate().find_map(|(k, one)| {
        let marker = body.marker(one.id)?;
        let rays_of = |seen: &DetectedMarker| seen.rays_in_camera.map(ray);
        let rays = rays_of(one);
        let same = own[k + 1..].iter().filter(|other| other.id == one.id);
        let apart_rad = same.map(|other| rays_of(other)).find_map(|others| {
            let apart_rad = middle(&rays).angle(&middle(&others));
            let nearest_m = marker.range_m(&rays).min(marker.range_m(&others));
            (apart_rad > 2.0 * body.radius() / nearest_m).then_some(apart_rad)
        })?;
        let apart_deg = apart_rad.to_degrees().round() as u32;
        Some(Notice::SeenTwice { body: body.name.clone(), marker: one.id, apart_deg })
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixtures::{alpha, bravo, facing_markers, pose};
    use nalgebra::{Isometry3, UnitQuaternion};

    /// What a frame shows of alphas, turned about the camera by these angles.
    fn shown(turns_deg: &[f64]) -> Vec<DetectedMarker> {
        let turned = |turn_deg: &f64| {
            let turn = UnitQuaternion::from_euler_angles(0.0, 0.0, turn_deg.to_radians());
            let at: Isometry3<f64> = turn * pose(0.9);
            facing_markers(&alpha(), &at, 4)
        };
        turns_deg.iter().flat_map(turned).collect()
    }

    #[test]
    fn one_marker_at_two_places_is_noticed_with_their_distance() {
        let twice = |turns_deg: &[f64]| seen_twice(&alpha(), shown(turns_deg).iter());
        assert_eq!(twice(&[0.0]), None);
        assert_eq!(twice(&[0.0, 0.1]), None, "it was seen in two views");
        let Some(Notice::SeenTwice { body, apart_deg, .. }) = twice(&[0.0, 40.0]) else {
            unreachable!("two bodies are there");
        };
        assert_eq!(body, "alpha");
        assert!((30..=45).contains(&apart_deg), "{apart_deg} degrees");
    }

    #[test]
    fn other_bodies_are_no_second_place() {
        assert_eq!(seen_twice(&bravo(), shown(&[0.0, 40.0]).iter()), None);
    }
}
