//! Markers that contradict each other.

use flockeye_geometry::Ray;
use flockeye_geometry::body::{Bodies, Body};

use crate::detector::MarkerInView;

/// Largest relative error of a marker's range from its longest side. It covers noise, and the
/// effect of a near marker's tilt.
const RANGE_ERROR: f64 = 0.3;

/// Two markers are never visible together if the cosine between their normals is below this: they
/// face away from each other by more than 143 degrees.
const MIN_NORMAL_COSINE: f64 = -0.8;

/// Largest distance of a marker's centre from its place on the body, in sides of the marker.
const CENTRE_SLACK: f64 = 0.5;

/// Leaves out markers that contradict others of the same body.
///
/// Two markers contradict each other if they face away from each other, or if their apparent sizes
/// put them farther apart than they are on the body. The marker with most contradictions is removed
/// first, then the one with the lowest log odds. Markers that no configured body carries stay.
pub fn keep_plausible(mut found: Vec<MarkerInView>, bodies: &Bodies) -> Vec<MarkerInView> {
    loop {
        let contradicted: Vec<usize> = (0..found.len())
            .map(|k| {
                let others = found.iter().enumerate().filter(|(other, _)| *other != k);
                others.filter(|(_, other)| contradict(&found[k], other, bodies)).count()
            })
            .collect();
        let worst = (0..found.len()).filter(|&k| contradicted[k] > 0).max_by(|&a, &b| {
            contradicted[a]
                .cmp(&contradicted[b])
                .then(found[b].log_odds.total_cmp(&found[a].log_odds))
        });
        let Some(worst) = worst else { return found };
        found.remove(worst);
    }
}

/// Whether two markers belong to one body that cannot show both at these places.
fn contradict(a: &MarkerInView, b: &MarkerInView, bodies: &Bodies) -> bool {
    let owner = bodies.owner(a.id);
    if a.id == b.id || owner.is_none() || owner != bodies.owner(b.id) {
        return false;
    }
    let body = owner.and_then(|index| bodies.get(index));
    let markers = |body: &'_ Body| Some((body.marker(a.id)?.clone(), body.marker(b.id)?.clone()));
    let Some((first, second)) = body.and_then(markers) else { return false };
    if first.normal().dot(&second.normal()) < MIN_NORMAL_COSINE {
        return true;
    }
    let (near, far) = {
        let ranges = [first.range_m(&a.rays_in_camera), second.range_m(&b.rays_in_camera)];
        (ranges[0].min(ranges[1]), ranges[0].max(ranges[1]))
    };
    let apart = (first.centre() - second.centre()).norm();
    let slack = RANGE_ERROR * far;
    let angle = central_ray(a).angle(&central_ray(b));
    far - near > apart + slack
        || near * angle.sin().abs() > apart * (1.0 + RANGE_ERROR) + CENTRE_SLACK * first.side()
}

fn central_ray(found: &MarkerInView) -> Ray {
    let sum = found.rays_in_camera.iter().map(|ray| ray.into_inner()).sum();
    Ray::new_normalize(sum)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;
    use flockeye_geometry::body::{Marker, squares};
    use flockeye_geometry::view::ViewPixel;
    use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};
    use proptest::prelude::*;

    fn bodies() -> Bodies {
        let list = vec![squares("alpha", 0.0625, 0.05, 0), squares("bravo", 0.0625, 0.05, 17)];
        Bodies::new("DICT_5X5_250".into(), list).unwrap()
    }

    fn seen(marker: &Marker, pose: &Isometry3<f64>, log_odds: f64) -> MarkerInView {
        MarkerInView {
            id: marker.id,
            corners_in_view: [ViewPixel::new(0.0, 0.0); 4],
            rays_in_camera: marker.corners.map(|corner| Ray::new_normalize((pose * corner).coords)),
            deviations_rad: [1e-4; 4],
            is_refined: true,
            log_odds,
        }
    }

    fn visible(body: &Body, pose: &Isometry3<f64>) -> Vec<MarkerInView> {
        let faces = |marker: &&Marker| {
            let towards = pose.inverse_transform_point(&Point3::origin()) - marker.centre();
            marker.normal().dot(&towards.normalize()) > 0.15
        };
        body.markers.iter().filter(faces).map(|marker| seen(marker, pose, 0.95)).collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig { failure_persistence: None, ..Default::default() })]

        #[test]
        fn markers_that_a_body_shows_together_are_kept(
            range in 0.2..4.0f64,
            turn in prop::array::uniform3(-3.0..3.0f64),
            at in prop::array::uniform3(-1.0..1.0f64),
        ) {
            let direction = Vector3::from(at);
            prop_assume!(direction.norm() > 0.1);
            let pose = Isometry3::from_parts(
                (direction.normalize() * range).into(),
                UnitQuaternion::from_scaled_axis(Vector3::from(turn)),
            );
            let bodies = bodies();
            let found = visible(bodies.get(0).unwrap(), &pose);
            prop_assert_eq!(keep_plausible(found.clone(), &bodies), found);
        }
    }

    #[test]
    fn markers_that_a_body_cannot_show_together_are_left_out() {
        let bodies = bodies();
        let alpha = bodies.get(0).unwrap();
        let pose = Isometry3::translation(1.0, 0.2, 0.1);
        let mut found = visible(alpha, &pose);
        let count = found.len();
        assert!(count >= 3);
        // One marker seen from behind, with lower log odds, and one at a much shorter range.
        // Another body's marker and one of no body are no contradiction.
        let facing = &alpha.markers[usize::try_from(found[0].id).unwrap()];
        let ahead = pose.translation.vector;
        let away = |marker: &&Marker| marker.normal().dot(&ahead);
        let hidden = alpha.markers.iter().max_by(|a, b| away(a).total_cmp(&away(b)));
        let mut wrong = vec![seen(hidden.unwrap(), &pose, 0.9)];
        found.retain(|marker| marker.id != facing.id);
        wrong.push(seen(facing, &Isometry3::translation(0.3, 0.06, 0.03), 0.99));
        let unrelated = [
            seen(&bodies.get(1).unwrap().markers[7], &Isometry3::translation(0.0, 2.0, 0.0), 0.9),
            MarkerInView { id: 99, ..seen(facing, &pose, 0.9) },
        ];
        let all: Vec<MarkerInView> =
            found.iter().chain(&wrong).chain(&unrelated).cloned().collect();
        let kept = keep_plausible(all, &bodies);
        let expected: Vec<MarkerInView> = found.iter().chain(&unrelated).cloned().collect();
        assert_eq!(kept, expected);
    }
}
