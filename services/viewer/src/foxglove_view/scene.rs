//! The neighbours as entities of Foxglove's scene, and their transforms.

use flockeye_config::Resolved;
use flockeye_contract::{Track, TrackState};
use flockeye_convert::{isometry, matrix6};
use flockeye_geometry::body::Body;
use foxglove::messages::{
    Duration, FrameTransform, FrameTransforms, LinePrimitive, SceneEntity, SceneEntityDeletion,
    SceneUpdate, SpherePrimitive, TextPrimitive, Timestamp, TriangleListPrimitive, Vector3,
    line_primitive, scene_entity_deletion,
};
use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion};

use super::values::{CAMERA, OBSERVER, colour, of_bytes, point, pose, quaternion, vector};

/// Standard deviations that an ellipsoid shows.
const SIGMAS: f64 = 2.0;
/// Lifetime of an entity that is not sent again, seconds.
const LIFETIME_S: i32 = 2;

/// The scene of a frame: each neighbour's body and ellipsoid, with its name. Lost neighbours are
/// deleted.
pub(super) fn scene(resolved: &Resolved, tracks: &[Track], at: Timestamp) -> SceneUpdate {
    let mut update = SceneUpdate::default();
    for track in tracks {
        let Some(body) = resolved.bodies.get(track.target as usize) else { continue };
        if track.state == TrackState::Lost.code() {
            update.deletions.push(SceneEntityDeletion {
                timestamp: Some(at),
                r#type: scene_entity_deletion::Type::MatchingId as i32,
                id: body.name.clone(),
            });
        } else {
            update.entities.push(entity(body, track, at));
        }
    }
    update
}

/// Transforms of the camera and the neighbours to this drone's frame.
pub(super) fn transforms(resolved: &Resolved, tracks: &[Track], at: Timestamp) -> FrameTransforms {
    let transform = |child: &str, observer_from_child: &Isometry3<f64>| FrameTransform {
        timestamp: Some(at),
        parent_frame_id: OBSERVER.to_owned(),
        child_frame_id: child.to_owned(),
        translation: Some(vector(&observer_from_child.translation.vector)),
        rotation: Some(quaternion(&observer_from_child.rotation)),
    };
    let is_there = |track: &&Track| track.state != TrackState::Lost.code();
    let targets = tracks.iter().filter(is_there).filter_map(|track| {
        let body = resolved.bodies.get(track.target as usize)?;
        Some(transform(&body.name, &isometry(&track.observer_from_target)))
    });
    let camera = transform(CAMERA, &resolved.observer_from_camera);
    FrameTransforms { transforms: std::iter::once(camera).chain(targets).collect() }
}

fn entity(body: &Body, track: &Track, at: Timestamp) -> SceneEntity {
    let observer_from_target = isometry(&track.observer_from_target);
    let observer_from_markers = observer_from_target * body.target_from_markers;
    let is_measured = [TrackState::Confirmed, TrackState::Measured]
        .iter()
        .any(|state| state.code() == track.state);
    let alpha = if is_measured { 1.0 } else { 0.4 };
    let facets = body.facets().iter();
    // A convex outline is a fan of triangles.
    let triangles = facets.clone().flat_map(|facet| {
        let outline = &facet.outline;
        (2..outline.len()).flat_map(|k| [outline[0], outline[k - 1], outline[k]])
    });
    let outlines = facets.map(|facet| LinePrimitive {
        r#type: line_primitive::Type::LineLoop as i32,
        pose: Some(pose(&observer_from_markers)),
        thickness: 1.0,
        scale_invariant: true,
        points: facet.outline.iter().map(point).collect(),
        color: Some(of_bytes([0x0d, 0x11, 0x17], alpha)),
        ..LinePrimitive::default()
    });
    let above = Translation3::new(0.0, 0.0, 1.6 * body.radius());
    SceneEntity {
        timestamp: Some(at),
        frame_id: OBSERVER.to_owned(),
        id: body.name.clone(),
        lifetime: Some(Duration::new(LIFETIME_S, 0)),
        triangles: vec![TriangleListPrimitive {
            pose: Some(pose(&observer_from_markers)),
            points: triangles.map(|corner| point(&corner)).collect(),
            color: Some(colour(track.target, alpha)),
            ..TriangleListPrimitive::default()
        }],
        lines: outlines.collect(),
        spheres: vec![ellipsoid(track, &observer_from_target)],
        texts: vec![TextPrimitive {
            pose: Some(pose(&(above * observer_from_target))),
            billboard: true,
            font_size: 14.0,
            scale_invariant: true,
            color: Some(colour(track.target, 1.0)),
            text: format!("{} {:.2} m", body.name, observer_from_target.translation.vector.norm()),
        }],
        ..SceneEntity::default()
    }
}

/// The ellipsoid of a track's position.
fn ellipsoid(track: &Track, observer_from_target: &Isometry3<f64>) -> SpherePrimitive {
    let covariance: Matrix3<f64> = matrix6(&track.covariance).fixed_view::<3, 3>(0, 0).into_owned();
    let eigen = covariance.symmetric_eigen();
    let mut axes = eigen.eigenvectors;
    if axes.determinant() < 0.0 {
        axes.column_mut(0).neg_mut();
    }
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
    let at = Isometry3::from_parts(observer_from_target.translation, rotation);
    // Foxglove's size is the diameter.
    let [x, y, z] = [0, 1, 2].map(|k| 2.0 * SIGMAS * eigen.eigenvalues[k].max(0.0).sqrt());
    SpherePrimitive {
        pose: Some(pose(&at)),
        size: Some(Vector3 { x, y, z }),
        color: Some(colour(track.target, 0.25)),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use bytemuck::Zeroable;
    use flockeye_config::Pipeline;
    use flockeye_contract::Pose;

    use super::*;

    fn track(state: TrackState) -> Track {
        let mut covariance = [0.0; 36];
        (covariance[0], covariance[7], covariance[14]) = (0.04, 0.01, 0.09);
        let pose = Pose { position: [1.0, 2.0, 2.0], ..Pose::default() };
        Track { state: state.code(), observer_from_target: pose, covariance, ..Track::zeroed() }
    }

    #[test]
    fn a_neighbour_is_an_entity_and_a_lost_one_is_deleted() {
        let resolved = Resolved::of(Pipeline::default()).unwrap();
        let at = Timestamp::new(5, 6);
        let update = scene(&resolved, &[track(TrackState::Confirmed)], at);
        let [entity] = &update.entities[..] else { panic!("{update:?}") };
        assert_eq!((entity.id.as_str(), entity.frame_id.as_str()), ("alpha", "observer"));
        assert_eq!(entity.texts[0].text, "alpha 3.00 m");
        let size = entity.spheres[0].size.unwrap();
        let mut sides = [size.x, size.y, size.z];
        sides.sort_by(f64::total_cmp);
        for (side, expected) in sides.into_iter().zip([0.4, 0.8, 1.2]) {
            assert!((side - expected).abs() < 1e-9, "{sides:?}");
        }
        // A solid of 18 squares and 8 triangles.
        assert_eq!(entity.triangles[0].points.len(), 3 * (18 * 2 + 8));
        let update = scene(&resolved, &[track(TrackState::Lost)], at);
        assert_eq!((update.entities.len(), update.deletions[0].id.as_str()), (0, "alpha"));
        let stranger = Track { target: 77, ..track(TrackState::Confirmed) };
        assert_eq!(scene(&resolved, &[stranger], at), SceneUpdate::default());
    }

    #[test]
    fn camera_and_neighbours_have_transforms() {
        let resolved = Resolved::of(Pipeline::default()).unwrap();
        let tracks = [track(TrackState::Confirmed), track(TrackState::Lost)];
        let sent = transforms(&resolved, &tracks, Timestamp::new(1, 0)).transforms;
        let children: Vec<_> = sent.iter().map(|sent| sent.child_frame_id.as_str()).collect();
        assert_eq!(children, ["camera", "alpha"]);
        assert_eq!(sent[1].translation.unwrap().z, 2.0);
    }
}
