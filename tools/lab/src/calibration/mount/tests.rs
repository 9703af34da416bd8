#![allow(clippy::unwrap_used, clippy::expect_used)]

use nalgebra::Translation3;
use proptest::prelude::*;

use super::*;
use flockeye_geometry::fixtures::{Chance, distance_squared, error};

/// Standard deviation of each coordinate of the measured places, metres.
const PLACE_M: f64 = 0.002;

/// A camera somewhere on a drone, turned by up to 20 degrees.
fn mount(chance: &mut Chance) -> Isometry3<f64> {
    let position = Vector3::from(chance.normals::<3>()) * 0.1;
    let turn = chance.direction().into_inner() * chance.even(0.0, 20f64.to_radians());
    Isometry3::from_parts(Translation3::from(position), UnitQuaternion::from_scaled_axis(turn))
}

/// Poses are worse along the line of sight than across it, and position and rotation go together.
fn covariance(position: &Vector3<f64>) -> Matrix6<f64> {
    let along = position.normalize();
    let across = Matrix3::identity() - along * along.transpose();
    let mut root = Matrix6::zeros();
    root.fixed_view_mut::<3, 3>(0, 0)
        .copy_from(&(along * along.transpose() * 0.006 + across * 0.0005));
    root.fixed_view_mut::<3, 3>(3, 3).copy_from(&(Matrix3::identity() * 0.01));
    root.fixed_view_mut::<3, 3>(3, 0).copy_from(&(Matrix3::identity() * 0.004));
    root * root.transpose()
}

/// A body at `count` places all around, 0.4 to 1.5 m away.
fn places(
    observer_from_camera: &Isometry3<f64>,
    count: usize,
    with_orientation: bool,
    chance: &mut Chance,
) -> Vec<MeasuredPlace> {
    let place = |_| {
        let range = chance.even(0.4, 1.5);
        let truth = chance.pose(range);
        let covariance = covariance(&truth.translation.vector);
        let root = covariance.cholesky().unwrap().l();
        let noise = root * Vector6::from(chance.normals::<6>());
        let observer_from_target = observer_from_camera * truth;
        let noise_m = Vector3::from(chance.normals::<3>()) * PLACE_M;
        let turn = UnitQuaternion::from_scaled_axis(Vector3::from(chance.normals::<3>()) * 0.02);
        MeasuredPlace {
            seen: StillPose {
                camera_from_target: moved(&truth, &noise),
                covariance,
                frames: 1,
                odd: 0,
            },
            in_observer: (observer_from_target.translation.vector + noise_m).into(),
            deviation_m: PLACE_M,
            orientation: with_orientation.then(|| (turn * observer_from_target.rotation, 0.02)),
        }
    };
    (0..count).map(place).collect()
}

/// Mean squared error in stated variances over many benches: 6 if these are right.
fn nees(seed: u64, benches: usize, count: usize, with_orientation: bool) -> f64 {
    let mut chance = Chance::new(seed);
    let errors = (0..benches).map(|_| {
        let truth = mount(&mut chance);
        let places = places(&truth, count, with_orientation, &mut chance);
        let found = fit(&places).unwrap();
        distance_squared(&error(&truth, &found.observer_from_camera), &found.covariance)
    });
    errors.sum::<f64>() / benches as f64
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 12, ..ProptestConfig::default() })]

    /// The sum over 150 mounts of six numbers each has 900 degrees of freedom.
    #[test]
    fn errors_are_as_large_as_stated(seed in any::<u64>()) {
        let benches = 150;
        let bound = |share: f64| chi_square_quantile(6.0 * benches as f64, share) / benches as f64;
        for (count, with_orientation) in [(6, false), (12, false), (5, true)] {
            let nees = nees(seed, benches, count, with_orientation);
            // One in ten thousand right ones fails on each side; the error is linearized.
            let (least, most) = (0.97 * bound(1e-4), 1.03 * bound(1.0 - 1e-4));
            prop_assert!((least..most).contains(&nees), "NEES {nees} for {count} places");
        }
    }
}

#[test]
fn without_noise_the_mount_is_exact() {
    let mut chance = Chance::new(3);
    let truth = mount(&mut chance);
    let mut exact = places(&truth, 4, true, &mut chance);
    for place in &mut exact {
        let (orientation, deviation) = place.orientation.unwrap();
        place.seen.camera_from_target =
            truth.inverse() * Isometry3::from_parts(place.in_observer.coords.into(), orientation);
        place.orientation = Some((orientation, deviation));
    }
    let found = fit(&exact).unwrap();
    assert!(error(&truth, &found.observer_from_camera).norm() < 1e-9);
    assert!(found.chi_square < 1e-9 && found.agreement == Agreement::Better);
    assert!(found.error_of_m(&truth, 1.5) < 1e-8);
}

#[test]
fn a_wrong_place_is_named_and_left_out() {
    let mut named = 0;
    for seed in 0..20 {
        let mut chance = Chance::new(seed);
        let truth = mount(&mut chance);
        let mut places = places(&truth, 8, false, &mut chance);
        // Read from the wrong end of the ruler.
        places[5].in_observer.x += 0.1;
        let found = fit(&places).unwrap();
        let left: Vec<bool> = found.places.iter().map(|place| !place.is_kept).collect();
        named += usize::from(left.iter().filter(|is| **is).count() == 1 && left[5]);
        assert_eq!(found.freedom, 3 * left.iter().filter(|is| !**is).count() - 6);
        assert!(found.places[5].residual_m.x > 0.06, "{:?}", found.places[5]);
        let squared =
            distance_squared(&error(&truth, &found.observer_from_camera), &found.covariance);
        assert!(squared < chi_square_quantile(6.0, 1.0 - 1e-5), "seed {seed}: {squared}");
    }
    assert!(named >= 18, "{named} of 20");
}

#[test]
fn places_that_all_disagree_are_said_to() {
    let mut chance = Chance::new(8);
    let truth = mount(&mut chance);
    let mut places = places(&truth, 8, false, &mut chance);
    for place in &mut places {
        let off = Vector3::from(chance.normals::<3>()) * 0.03;
        place.in_observer += off;
    }
    let found = fit(&places).unwrap();
    assert_eq!(found.agreement, Agreement::Worse);
    assert!(found.places.iter().all(|place| place.is_kept));
    let squared = distance_squared(&error(&truth, &found.observer_from_camera), &found.covariance);
    assert!(squared < chi_square_quantile(6.0, 0.9999), "enlarged: {squared}");
}

#[test]
fn nobody_says_which_of_four_is_wrong_when_two_may_be() {
    let mut chance = Chance::new(9);
    let truth = mount(&mut chance);
    let mut places = places(&truth, 4, false, &mut chance);
    places[0].in_observer.y += 0.08;
    let found = fit(&places).unwrap();
    // Three places always agree within six of nine numbers, more or less: none of them is accused
    // wrongly.
    assert!(found.places.iter().skip(1).all(|place| place.is_kept), "{:?}", found.places);
    assert!(!found.places[0].is_kept || found.agreement == Agreement::Worse);
}

#[test]
fn places_that_do_not_tell_are_refused_with_the_cure() {
    let mut chance = Chance::new(10);
    let truth = mount(&mut chance);
    let all = places(&truth, 6, false, &mut chance);
    let says = |places: &[MeasuredPlace]| fit(places).unwrap_err().to_string();
    assert!(says(&all[..2]).contains("2 places with a pose; 3 or more are needed. Cure:"));
    // Along a line, and all within a few centimetres.
    let at = |positions: &[[f64; 3]]| -> Vec<MeasuredPlace> {
        let place = |(place, position): (&MeasuredPlace, &[f64; 3])| {
            let in_observer = Point3::from(*position);
            let seen = Isometry3::from_parts(
                (truth.inverse() * in_observer).coords.into(),
                UnitQuaternion::identity(),
            );
            let seen = StillPose { camera_from_target: seen, ..place.seen.clone() };
            MeasuredPlace { in_observer, seen, ..place.clone() }
        };
        all.iter().zip(positions).map(place).collect()
    };
    let line = at(&[[0.4, 0.0, 0.0], [0.8, 0.0, 0.0], [1.2, 0.0, 0.0], [1.5, 0.0, 0.0]]);
    let said = says(&line);
    assert!(said.contains("about (1.00, 0.00, 0.00)") && said.contains("Cure:"), "{said}");
    let near = at(&[[0.8, 0.0, 0.0], [0.83, 0.02, 0.0], [0.8, 0.03, 0.02], [0.82, 0.0, 0.03]]);
    assert!(says(&near).contains("farther apart"), "{}", says(&near));
    let mut wrong = all.clone();
    wrong[3].deviation_m = f64::NAN;
    assert!(says(&wrong).contains("place 4 (counted from 1)"), "{}", says(&wrong));
}
