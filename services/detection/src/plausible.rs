//! Markers that contradict each other.

use flockeye_geometry::Ray;
use flockeye_geometry::body::{Bodies, Body, Marker};

use crate::Found;

/// Markers' distances from the camera, by their longest sides, are right to within this share: noise,
/// and what a near marker's tilt adds.
const RANGE_SHARE: f64 = 0.3;

/// Markers whose normals point more than the angle of this cosine apart are never seen together.
const MAX_TURNED: f64 = -0.8;

/// Leaves out markers that no body could show beside the others: two of one body that look away from
/// each other, or lie farther apart than it is wide, by their apparent size. Of each such
/// pair the one goes that more of the body's markers contradict, or that reads worse; but doubtful ones
/// say nothing against one that was read: in a hall full of windows several contradict it. Markers that
/// nobody carries stay.
pub fn keep_plausible(mut found: Vec<Found>, bodies: &Bodies) -> Vec<Found> {
    loop {
        let contradicted: Vec<usize> = (0..found.len())
            .map(|k| {
                let others = found.iter().enumerate().filter(|(other, _)| *other != k);
                let heard = others.filter(|(_, other)| found[k].is_doubtful || !other.is_doubtful);
                heard.filter(|(_, other)| contradict(&found[k], other, bodies)).count()
            })
            .collect();
        let worst = (0..found.len()).filter(|&k| contradicted[k] > 0).max_by(|&a, &b| {
            contradicted[a]
                .cmp(&contradicted[b])
                .then(found[b].agreement.total_cmp(&found[a].agreement))
        });
        let Some(worst) = worst else { return found };
        found.remove(worst);
    }
}

/// Whether two markers are of one body, which cannot show both as they are.
fn contradict(a: &Found, b: &Found, bodies: &Bodies) -> bool {
    let owner = bodies.owner(a.id);
    if a.id == b.id || owner.is_none() || owner != bodies.owner(b.id) {
        return false;
    }
    let body = owner.and_then(|index| bodies.get(index));
    let markers = |body: &'_ Body| Some((body.marker(a.id)?.clone(), body.marker(b.id)?.clone()));
    let Some((first, second)) = body.and_then(markers) else { return false };
    if first.normal().dot(&second.normal()) < MAX_TURNED {
        return true;
    }
    let (near, far) = {
        let ranges = [range(a, &first), range(b, &second)];
        (ranges[0].min(ranges[1]), ranges[0].max(ranges[1]))
    };
    let apart = (first.centre() - second.centre()).norm();
    let slack = RANGE_SHARE * far;
    let angle = middle(a).angle(&middle(b));
    far - near > apart + slack
        || near * angle.sin().abs() > apart * (1.0 + RANGE_SHARE) + 0.5 * first.side()
}

/// How far a marker is, by the longest of its sides, metres: what a tilt shortens least.
fn range(found: &Found, marker: &Marker) -> f64 {
    let rays = &found.rays_in_camera;
    let longest = (0..4).map(|k| rays[k].angle(&rays[(k + 1) % 4])).fold(0.0, f64::max);
    marker.side() / longest.max(1e-6)
}

fn middle(found: &Found) -> Ray {
    let sum = found.rays_in_camera.iter().map(|ray| ray.into_inner()).sum();
    Ray::new_normalize(sum)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;
    use flockeye_geometry::body::squares;
    use flockeye_geometry::view::ViewPixel;
    use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};
    use proptest::prelude::*;

    fn bodies() -> Bodies {
        let list = vec![squares("alpha", 0.0625, 0.05, 0), squares("bravo", 0.0625, 0.05, 17)];
        Bodies::new("DICT_5X5_250".into(), list).unwrap()
    }

    fn seen(marker: &Marker, pose: &Isometry3<f64>, agreement: f32) -> Found {
        Found {
            id: marker.id,
            corners_in_view: [ViewPixel::new(0.0, 0.0); 4],
            rays_in_camera: marker.corners.map(|corner| Ray::new_normalize((pose * corner).coords)),
            deviations_rad: [1e-4; 4],
            is_refined: true,
            agreement,
            is_doubtful: false,
        }
    }

    fn visible(body: &Body, pose: &Isometry3<f64>) -> Vec<Found> {
        let faces = |marker: &&Marker| {
            let towards = pose.inverse_transform_point(&Point3::origin()) - marker.centre();
            marker.normal().dot(&towards.normalize()) > 0.15
        };
        body.markers.iter().filter(faces).map(|marker| seen(marker, pose, 0.95)).collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig { failure_persistence: None, ..Default::default() })]

        #[test]
        fn what_a_body_shows_stays(
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
    fn what_it_cannot_show_goes() {
        let bodies = bodies();
        let alpha = bodies.get(0).unwrap();
        let pose = Isometry3::translation(1.0, 0.2, 0.1);
        let mut found = visible(alpha, &pose);
        let count = found.len();
        assert!(count >= 3);
        // From behind, and read worse; much nearer. Another body's marker, and a stranger, may be there.
        let facing = &alpha.markers[usize::try_from(found[0].id).unwrap()];
        let ahead = pose.translation.vector;
        let away = |marker: &&Marker| marker.normal().dot(&ahead);
        let hidden = alpha.markers.iter().max_by(|a, b| away(a).total_cmp(&away(b)));
        let mut wrong = vec![seen(hidden.unwrap(), &pose, 0.9)];
        found.retain(|marker| marker.id != facing.id);
        wrong.push(seen(facing, &Isometry3::translation(0.3, 0.06, 0.03), 0.99));
        let strangers = [
            seen(&bodies.get(1).unwrap().markers[7], &Isometry3::translation(0.0, 2.0, 0.0), 0.9),
            Found { id: 99, ..seen(facing, &pose, 0.9) },
        ];
        let all: Vec<Found> = found.iter().chain(&wrong).chain(&strangers).cloned().collect();
        let kept = keep_plausible(all, &bodies);
        let expected: Vec<Found> = found.iter().chain(&strangers).cloned().collect();
        assert_eq!(kept, expected);
    }

    #[test]
    fn squares_that_look_like_markers_say_nothing_against_one_that_was_read() {
        let bodies = bodies();
        let alpha = bodies.get(0).unwrap();
        let pose = Isometry3::translation(1.0, 0.2, 0.1);
        let read = visible(alpha, &pose)[0].clone();
        let others = alpha.markers.iter().filter(|marker| marker.id != read.id);
        // All over the view, at other distances.
        let doubtful: Vec<Found> = (0..4)
            .zip(others)
            .map(|(k, marker)| {
                let elsewhere = Isometry3::translation(0.4, 0.3 * f64::from(k) - 0.5, 0.2);
                Found { is_doubtful: true, ..seen(marker, &elsewhere, 0.99) }
            })
            .collect();
        let all = doubtful.iter().chain([&read]).cloned().collect();
        assert_eq!(keep_plausible(all, &bodies), [read]);
    }
}
