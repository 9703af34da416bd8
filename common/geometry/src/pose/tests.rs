#![allow(clippy::unwrap_used, clippy::expect_used)]

use nalgebra::{Unit, Vector3, Vector6};
use proptest::prelude::*;

use super::residual::{error_and_jacobian, moved};
use super::*;
use crate::body::{Body, Marker};
use crate::filter::chi_square_quantile;
use crate::fixtures::{Chance, body, distance_squared, error, see, visible};

/// Some of the markers that are well visible; at least `least`, if there are so many.
fn some_visible<'a>(
    body: &'a Body,
    pose: &Isometry3<f64>,
    least: usize,
    chance: &mut Chance,
) -> Vec<&'a Marker> {
    let mut markers = visible(body, pose, 0.25);
    while markers.len() > least && chance.even(0.0, 1.0) < 0.5 {
        markers.remove(chance.even(0.0, markers.len() as f64) as usize);
    }
    markers
}

#[test]
fn a_pose_is_false_by_its_position_or_by_its_rotation() {
    let at = |x_m: f64, turn_deg: f64| {
        Isometry3::new(Vector3::new(x_m, 0.0, 1.0), Vector3::y() * turn_deg.to_radians())
    };
    let is_false = |x_m, turn_deg| is_false(&at(x_m, turn_deg), &at(0.0, 0.0));
    assert!(!is_false(0.099, 9.9));
    assert!(is_false(0.101, 0.0) && is_false(0.0, 10.1));
}

#[test]
fn the_sharper_of_two_sightings_stays() {
    let ray = |marker_id, corner, deviation_rad, y| CornerRay {
        marker_id,
        corner,
        ray_in_camera: Unit::new_normalize(Vector3::new(1.0, y, 0.0)),
        deviation_rad,
    };
    let kept = keep_sharpest(&[
        ray(7, 1, 2e-3, 0.1),
        ray(3, 0, 1e-3, 0.2),
        ray(7, 1, 1e-3, 0.3),
        ray(7, 4, 1e-3, 0.4),
        ray(7, 2, f64::NAN, 0.5),
        ray(7, 3, 1e-3, f64::NAN),
        ray(7, 1, 1e-3, 0.6),
    ]);
    assert_eq!(kept, [ray(3, 0, 1e-3, 0.2), ray(7, 1, 1e-3, 0.3)]);
}

#[test]
fn one_marker_at_two_places_is_outvoted_where_the_others_do_not_see_it() {
    let (mut chance, body) = (Chance::new(5), body());
    let pose = chance.pose(1.0);
    let mut rays: Vec<CornerRay> =
        body.markers.iter().flat_map(|marker| see(marker, &pose, 1e-4, &mut chance)).collect();
    let honest = solve(&body, &rays).unwrap();
    // The same marker on another drone, nearer and sharper.
    let elsewhere = Isometry3::translation(0.1, 0.3, -0.2) * pose;
    let other = see(&body.markers[3], &elsewhere, 1e-5, &mut chance);
    rays.splice(0..0, other);
    let found = solve(&body, &rays).unwrap();
    let apart = honest[0].camera_from_markers.inverse() * found[0].camera_from_markers;
    assert!(apart.translation.vector.norm() < 1e-3, "{apart}");
    assert_eq!(found[0].inlier_corners, honest[0].inlier_corners);
}

proptest! {
    #[test]
    fn the_analytic_jacobian_is_the_numeric_one(seed: u64, range in 0.3..4.0f64) {
        let (mut chance, body) = (Chance::new(seed), body());
        let pose = chance.pose(range);
        let rays = see(&body.markers[3], &pose, 1e-2, &mut chance);
        let markers = rays::sighted(&body, &rays);
        for sight in &markers[0].sights {
            let (_, jacobian) = error_and_jacobian(sight, &pose).unwrap();
            for k in 0..6 {
                let mut step = Vector6::zeros();
                step[k] = 1e-6;
                let after = residual::error(sight, &moved(&pose, &step)).unwrap();
                let before = residual::error(sight, &moved(&pose, &-step)).unwrap();
                let numeric = (after - before) / 2e-6;
                prop_assert!((numeric - jacobian.column(k)).norm() < 1e-6 * (1.0 + jacobian.norm()));
            }
        }
    }

    #[test]
    fn one_of_the_two_poses_of_an_exact_square_is_its_own(seed: u64, range in 0.1..4.0f64) {
        let (mut chance, body) = (Chance::new(seed), body());
        let pose = chance.pose(range);
        for marker in visible(&body, &pose, 0.1) {
            let rays = marker.corners.map(|corner| (pose * corner).coords.normalize());
            let poses = ippe::poses_of_square(marker.side(), &rays).unwrap();
            let truth = pose * marker.markers_from_marker();
            let nearest = poses.iter().map(|found| error(&truth, found).norm()).fold(9.0, f64::min);
            prop_assert!(nearest < 1e-5, "{nearest}");
        }
    }

    #[test]
    fn two_markers_or_more_give_the_pose_within_its_covariance(
        seed: u64,
        range in 0.3..4.0f64,
        pixels in 0.05..0.6f64,
    ) {
        let (mut chance, body) = (Chance::new(seed), body());
        let pose = chance.pose(range);
        let markers = some_visible(&body, &pose, 2, &mut chance);
        prop_assume!(markers.len() >= 2);
        let rays: Vec<_> = markers
            .iter()
            .flat_map(|marker| see(marker, &pose, pixels / 611.0, &mut chance))
            .collect();
        let solutions = solve(&body, &rays).unwrap();
        let choice = choose(&solutions, None).unwrap();
        // 6.7 deviations of chi-square with 6 degrees: one in 10^7 exceeds 44.
        let distance = distance_squared(
            &error(&pose, &choice.camera_from_markers),
            &choice.covariance,
        );
        prop_assert!(distance < 50.0, "{distance} {choice:?}");
        // Once in many thousands a corner is noisy enough to look like an outlier.
        prop_assert!(choice.inlier_markers.len() + 1 >= markers.len());
        for solution in &solutions {
            for id in &solution.inlier_markers {
                let marker = body.marker(*id).unwrap();
                let facing = visible(&body, &solution.camera_from_markers, -0.06);
                prop_assert!(facing.iter().any(|other| other.id == marker.id));
            }
        }
    }

    #[test]
    fn misread_markers_are_outvoted(seed: u64, range in 0.3..3.0f64, turned: bool) {
        let (mut chance, body) = (Chance::new(seed), body());
        let pose = chance.pose(range);
        let markers = visible(&body, &pose, 0.2);
        prop_assume!(markers.len() >= 3);
        let wrong = (markers.len() * 3 / 10).max(1);
        let mut rays: Vec<_> = markers
            .iter()
            .flat_map(|marker| see(marker, &pose, 0.3 / 611.0, &mut chance))
            .collect();
        // Each misread in another way: as a marker that is not in sight, or turned by a quarter.
        let mut unseen = body.markers.iter().filter(|other| {
            markers.iter().all(|marker| marker.id != other.id)
        });
        for k in 0..wrong {
            let id = unseen.next().unwrap().id;
            for ray in &mut rays[4 * k..4 * k + 4] {
                if turned {
                    ray.corner = (ray.corner + 1) % 4;
                } else {
                    ray.marker_id = id;
                }
            }
        }
        let solutions = solve(&body, &rays).unwrap();
        let choice = choose(&solutions, None).unwrap();
        let right: Vec<u32> = markers[wrong..].iter().map(|marker| marker.id).collect();
        let inliers = &choice.inlier_markers;
        prop_assert!(inliers.iter().all(|id| right.contains(id)), "{inliers:?} {right:?}");
        // Once in many thousands a corner is noisy enough to look like an outlier.
        prop_assert!(inliers.len() + 1 >= right.len(), "{inliers:?} {right:?}");
        let distance = distance_squared(
            &error(&pose, &choice.camera_from_markers),
            &choice.covariance,
        );
        prop_assert!(distance < 50.0, "{}", distance);
    }

    #[test]
    fn no_rays_whatever_make_it_panic(
        numbers in proptest::collection::vec(
            (0u32..20, 0usize..5, prop::array::uniform3(-1.0..1.0f64), -0.1..0.2f64), 0..40),
    ) {
        let rays: Vec<_> = numbers
            .into_iter()
            .map(|(marker_id, corner, [x, y, z], deviation_rad)| CornerRay {
                marker_id,
                corner,
                ray_in_camera: Unit::new_unchecked(Vector3::new(x, y, z) / (x * x + y * y + z * z).sqrt()),
                deviation_rad,
            })
            .collect();
        if let Ok(solutions) = solve(&body(), &rays) {
            prop_assert!(solutions.iter().all(|solution| solution.inlier_corners >= 4));
        }
    }
}

/// Mean squared Mahalanobis distances over runs, of the pose, its position, its rotation.
#[derive(Default)]
struct Consistency {
    runs: f64,
    sums: [f64; 3],
}

impl Consistency {
    fn add(&mut self, pose: &nalgebra::Isometry3<f64>, found: &PoseSolution) {
        let error = error(pose, &found.camera_from_markers);
        let covariance = &found.covariance;
        let part = |k: usize| {
            let error = error.fixed_rows::<3>(k).into_owned();
            let part = covariance.fixed_view::<3, 3>(k, k).into_owned();
            error.dot(&part.cholesky().unwrap().solve(&error))
        };
        self.runs += 1.0;
        let distances = [distance_squared(&error, covariance), part(0), part(3)];
        for (sum, distance) in self.sums.iter_mut().zip(distances) {
            *sum += distance;
        }
    }

    /// That the means lie where 95 % of those of chi-square's do.
    fn check(&self) {
        let means = self.sums.map(|sum| sum / self.runs);
        println!("{} runs: {means:.3?}", self.runs);
        for (mean, freedom) in means.into_iter().zip([6.0, 3.0, 3.0f64]) {
            let deviation = (2.0 * freedom / self.runs).sqrt();
            assert!((mean - freedom).abs() < 1.96 * deviation, "{mean} +- {deviation}");
        }
    }
}

/// In the tail, which decides. In the mean they are somewhat nearer, because the nearer one of two
/// poses counts.
#[test]
fn right_corners_are_as_far_from_a_square_as_they_are_uncertain() {
    let (mut chance, body) = (Chance::new(5), body());
    let mut squared: Vec<f64> = Vec::new();
    while squared.len() < 4000 {
        let range = chance.even(0.3, 2.0);
        let pose = chance.pose(range);
        for marker in visible(&body, &pose, 0.25) {
            let seen = see(marker, &pose, 0.2 / 611.0, &mut chance);
            let rays = std::array::from_fn(|k| seen[k].ray_in_camera);
            let deviations_rad = std::array::from_fn(|k| seen[k].deviation_rad);
            squared.push(squared_distance_from_square(&rays, &deviations_rad).unwrap());
        }
    }
    let within = |probability| {
        let limit = chi_square_quantile(2.0, probability);
        squared.iter().filter(|&&squared| squared <= limit).count() as f64 / squared.len() as f64
    };
    // Four standard deviations of the count either way.
    assert!((within(0.99) - 0.99).abs() < 0.0063, "{}", within(0.99));
    assert!((within(0.999) - 0.999).abs() < 0.002, "{}", within(0.999));
}

#[test]
fn the_covariance_is_consistent() {
    let (mut chance, body) = (Chance::new(5), body());
    let mut consistency = Consistency::default();
    while consistency.runs < 16000.0 {
        let range = chance.even(0.4, 2.5);
        let pose = chance.pose(range);
        let markers = some_visible(&body, &pose, 3, &mut chance);
        if markers.len() < 3 {
            continue;
        }
        let rays: Vec<_> =
            markers.iter().flat_map(|marker| see(marker, &pose, 2e-4, &mut chance)).collect();
        let solutions = solve(&body, &rays).unwrap();
        consistency.add(&pose, &solutions[0]);
    }
    consistency.check();
}

#[test]
fn a_third_of_wrong_corners_is_put_aside() {
    let (mut chance, body) = (Chance::new(15), body());
    let mut consistency = Consistency::default();
    let (mut runs, mut right) = (0, 0);
    while runs < 1500 {
        let range = chance.even(0.4, 2.0);
        let pose = chance.pose(range);
        let markers = visible(&body, &pose, 0.25);
        if markers.len() < 4 {
            continue;
        }
        runs += 1;
        let deviation = 0.15 / 611.0;
        let mut rays: Vec<_> =
            markers.iter().flat_map(|marker| see(marker, &pose, deviation, &mut chance)).collect();
        // As where something covers a corner, and the edges of another thing cross.
        let mut sound: Vec<usize> = (0..rays.len()).collect();
        for _ in 0..rays.len() * 3 / 10 {
            let wrong = sound.swap_remove(chance.even(0.0, sound.len() as f64) as usize);
            let off = chance.direction().into_inner() * chance.even(0.3, 1.5) * 0.05 / range;
            let ray = &mut rays[wrong].ray_in_camera;
            *ray = Unit::new_normalize(ray.into_inner() + off);
        }
        let Ok(solutions) = solve(&body, &rays) else { continue };
        let found = &solutions[0];
        if error(&pose, &found.camera_from_markers).fixed_rows::<3>(3).norm() < 0.2 {
            right += 1;
            consistency.add(&pose, found);
        }
    }
    println!("{right} of {runs} right");
    assert!(right * 100 >= runs * 98, "{right} of {runs}");
    let mean = consistency.sums[0] / consistency.runs;
    println!("mean squared distance {mean:.2}");
    // Wrong corners that happen to lie nearly right are taken for right ones.
    assert!(mean < 9.0, "{mean}");
}

/// The right one of two solutions is chosen wherever their costs differ clearly.
#[test]
fn a_clear_choice_is_the_right_one() {
    let (mut chance, body) = (Chance::new(25), body());
    let (mut clear, mut wrong, mut unclear) = (0, 0, 0);
    for _ in 0..3000 {
        let range = chance.even(0.4, 4.0);
        let pose = chance.pose(range);
        let markers = some_visible(&body, &pose, 1, &mut chance);
        let deviation = chance.even(0.05, 0.6) / 611.0;
        let rays: Vec<_> =
            markers.iter().flat_map(|marker| see(marker, &pose, deviation, &mut chance)).collect();
        let Ok(solutions) = solve(&body, &rays) else { continue };
        let choice = choose(&solutions, None).unwrap();
        if margin_and_ratio(&solutions, None).0 < 12.0 {
            unclear += 1;
            continue;
        }
        clear += 1;
        let distance =
            distance_squared(&error(&pose, &choice.camera_from_markers), &choice.covariance);
        wrong += i32::from(distance > 60.0);
    }
    println!("{clear} clear, {wrong} of them wrong, {unclear} unclear");
    // A margin of 12 is a likelihood ratio of 400.
    assert!(clear > 2000 && wrong * 400 < clear, "{wrong} of {clear}, {unclear} unclear");
}

#[test]
fn two_facets_well_seen_leave_no_doubt_of_the_mirror() {
    let (mut chance, body) = (Chance::new(2), body());
    let mut runs = 0;
    while runs < 300 {
        let range = chance.even(0.4, 2.2);
        let pose = chance.pose(range);
        let markers = visible(&body, &pose, 0.4);
        if markers.len() < 2 {
            continue;
        }
        let rays: Vec<_> = markers[..2]
            .iter()
            .flat_map(|marker| see(marker, &pose, 0.3 / 611.0, &mut chance))
            .collect();
        let solutions = solve(&body, &rays).unwrap();
        let choice = choose(&solutions, None).unwrap();
        assert!(error(&pose, &choice.camera_from_markers).fixed_rows::<3>(3).norm() < 0.3);
        let (margin, ratio) = margin_and_ratio(&solutions, None);
        assert!(margin > 9.0 && ratio < 0.9, "{choice:?}");
        runs += 1;
    }
}

/// The runner-up's cost less the best solution's, and the best one's share of it.
fn margin_and_ratio(solutions: &[PoseSolution], predicted: Option<&PoseEstimate>) -> (f64, f64) {
    match choice::ranked(solutions, predicted)[..] {
        [(cost, _), (other, _), ..] if other > 0.0 => (other - cost, cost / other),
        [_, _, ..] => (0.0, 1.0),
        _ => (f64::INFINITY, 0.0),
    }
}

/// A pose two metres ahead in which marker 5 (+x of its body) is seen 25 degrees from its front.
fn slanted() -> Isometry3<f64> {
    let towards = nalgebra::UnitQuaternion::from_euler_angles(0.0, 0.0, std::f64::consts::PI);
    let tilt = nalgebra::UnitQuaternion::from_euler_angles(0.2, 0.4, 0.1);
    Isometry3::from_parts(Vector3::new(2.0, 0.1, -0.2).into(), tilt * towards)
}

#[test]
fn a_single_far_marker_keeps_both_mirrors_until_the_track_decides() {
    let (mut chance, body) = (Chance::new(3), body());
    let pose = slanted();
    let rays = see(body.marker(5).unwrap(), &pose, 0.3 / 611.0, &mut chance);
    let solutions = solve(&body, &rays).unwrap();
    assert_eq!(solutions.len(), 2);
    assert!(solutions[0].cost <= solutions[1].cost);
    assert!(solutions.iter().all(|solution| {
        visible(&body, &solution.camera_from_markers, 0.0).iter().any(|marker| marker.id == 5)
    }));
    let undecided = margin_and_ratio(&solutions, None);
    assert!(undecided.0 < 9.0, "{undecided:?}");
    let clear = 120f64.ln();
    assert!(lead(&solutions, &solutions[0], None) < clear);
    assert_eq!(lead(&solutions[..1], &solutions[0], None), f64::INFINITY, "it has no rival");
    // Whichever of them is expected is chosen, and then without doubt.
    for expected in &solutions {
        let prior = PoseEstimate {
            camera_from_markers: expected.camera_from_markers,
            covariance: Matrix6::identity() * 0.05f64.powi(2),
        };
        let choice = choose(&solutions, Some(&prior)).unwrap();
        assert_eq!(choice, expected);
        let [chosen, other] = [choice, solutions.iter().find(|other| *other != choice).unwrap()]
            .map(|one| lead(&solutions, one, Some(&prior)));
        assert!(chosen > clear && other < 0.0, "{chosen}, {other}");
        let (margin, ratio) = margin_and_ratio(&solutions, Some(&prior));
        assert!(margin > 9.0 && ratio < 0.9, "{choice:?}");
    }
}

#[test]
fn corners_worse_than_they_state_still_count() {
    // Detectors make markers too small: here by 6 % of the side, eleven stated deviations.
    let (mut chance, body) = (Chance::new(4), body());
    let pose = slanted();
    let markers = visible(&body, &pose, 0.3);
    let mut rays = Vec::new();
    for marker in &markers {
        let mut shrunk = (*marker).clone();
        for corner in &mut shrunk.corners {
            *corner = marker.centre() + (*corner - marker.centre()) * 0.94;
        }
        rays.extend(see(&shrunk, &pose, 1e-4, &mut chance));
    }
    let solutions = solve(&body, &rays).unwrap();
    let found = &solutions[0];
    assert_eq!(found.inlier_markers.len(), markers.len());
    assert!(found.reduced_chi_square > 3.0);
    assert!(found.inflated_covariance()[(0, 0)] > 3.0 * found.covariance[(0, 0)]);
    assert!(error(&pose, &found.camera_from_markers).fixed_rows::<3>(3).norm() < 0.1);
}

#[test]
fn the_order_of_the_rays_does_not_matter() {
    let (mut chance, body) = (Chance::new(6), body());
    let pose = slanted();
    let mut rays: Vec<_> = visible(&body, &pose, 0.2)
        .iter()
        .flat_map(|marker| see(marker, &pose, 1e-3, &mut chance))
        .collect();
    let solutions = solve(&body, &rays).unwrap();
    rays.reverse();
    rays.extend(rays.clone());
    assert_eq!(solve(&body, &rays).unwrap(), solutions);
}

#[test]
fn what_cannot_be_solved_is_refused() {
    let (mut chance, body) = (Chance::new(8), body());
    let pose = slanted();
    let rays = see(body.marker(5).unwrap(), &pose, 1e-3, &mut chance);
    let given = |rays: &[CornerRay]| solve(&body, rays);
    assert_eq!(given(&[]), Err(PoseError::TooFewRays { usable: 0, given: 0 }));
    assert_eq!(given(&rays[..3]), Err(PoseError::TooFewRays { usable: 3, given: 3 }));
    let mut broken = rays.clone();
    broken[1].ray_in_camera = Unit::new_unchecked(Vector3::new(f64::NAN, 0.0, 1.0));
    assert_eq!(given(&broken), Err(PoseError::TooFewRays { usable: 3, given: 4 }));
    let strange: Vec<_> = rays.iter().map(|ray| CornerRay { marker_id: 99, ..*ray }).collect();
    assert_eq!(given(&strange), Err(PoseError::TooFewRays { usable: 0, given: 4 }));
    let two =
        [rays[..3].to_vec(), see(body.marker(6).unwrap(), &pose, 1e-3, &mut chance)[..3].to_vec()]
            .concat();
    assert!(matches!(given(&two), Err(PoseError::NoWholeMarker { markers: 2 })));
    // All four corners in one place are no square; seen from behind, there is no marker.
    let point: Vec<_> =
        rays.iter().map(|ray| CornerRay { ray_in_camera: rays[0].ray_in_camera, ..*ray }).collect();
    assert_eq!(given(&point), Err(PoseError::NothingFits { markers: 1 }));
    let mirrored: Vec<_> =
        rays.iter().map(|ray| CornerRay { corner: 3 - ray.corner, ..*ray }).collect();
    assert_eq!(given(&mirrored), Err(PoseError::NothingFits { markers: 1 }));
    assert_eq!(choose(&[], None), None);
}
