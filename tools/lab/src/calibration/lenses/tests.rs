#![allow(clippy::unwrap_used, clippy::expect_used)]

use nalgebra::{Rotation3, Translation3, Unit, UnitQuaternion, Vector2};

use super::*;
use flockeye_geometry::camera::Lens;
use flockeye_geometry::filter::chi_square_quantile;
use flockeye_geometry::fixtures::{Chance, body, distance_squared, error, visible};

/// Standard deviation of each ray, radians: a sixth of a pixel of 3840.
const RAY_RAD: f64 = 3e-4;
/// Distance for which the rays are valid, metres.
const ASSUMED_M: f64 = 1.5;

fn stitched(lens_distance_m: f64) -> Camera {
    let model = CameraModel::Equirectangular { lens_distance_m };
    Camera::new(3840, 1920, model).unwrap().at_distance(ASSUMED_M)
}

/// Two equidistant lenses, 8 mm before and behind the middle; the second moved and turned by a
/// step.
fn fisheyes(step: &Vector6<f64>) -> Camera {
    let lens = |ahead: f64, u: f64| {
        let direction = Vector3::x() * ahead;
        let right = direction.cross(&Vector3::z());
        let axes = Rotation3::from_basis_unchecked(&[right, direction.cross(&right), direction]);
        let rotation = UnitQuaternion::from_rotation_matrix(&axes);
        let pose = Isometry3::from_parts(Translation3::from(direction * 0.008), rotation);
        let field_rad = 195f64.to_radians();
        Lens::equidistant(pose, Vector2::new(u, 959.5), 955.0, field_rad)
    };
    let mut lenses = [lens(1.0, 959.5), lens(-1.0, 2879.5)];
    lenses[1].camera_from_lens =
        crate::calibration::weighted_ray::moved(&lenses[1].camera_from_lens, step);
    Camera::new(3840, 1920, CameraModel::DualFisheye(lenses)).unwrap().at_distance(ASSUMED_M)
}

fn pose_of_second(camera: &Camera) -> Isometry3<f64> {
    match camera.model() {
        CameraModel::DualFisheye(lenses) => lenses[1].camera_from_lens,
        model => panic!("{model:?} has no second lens"),
    }
}

/// Frames of a body at the seam, as `real` shows them and as who believes in `believed` reads them.
fn recorded(
    real: &Camera,
    believed: &Camera,
    count: usize,
    longitudes: [f64; 2],
    chance: &mut Chance,
) -> Vec<Vec<CornerRay>> {
    let body = body();
    let frame = |_| {
        let (range, round) = (chance.even(0.35, 0.8), chance.even(longitudes[0], longitudes[1]));
        let across = Vector3::new(0.0, round.cos(), round.sin()) * range;
        let position = across + Vector3::x() * chance.even(-0.03, 0.03);
        let pose = Isometry3::from_parts(Translation3::from(position), chance.rotation());
        let mut rays = Vec::new();
        for marker in visible(&body, &pose, 0.35) {
            let seen: Option<Vec<CornerRay>> =
                (0..4).map(|corner| see(real, believed, marker, corner, &pose, chance)).collect();
            rays.extend(seen.unwrap_or_default());
        }
        rays
    };
    (0..count).map(frame).collect()
}

fn see(
    real: &Camera,
    believed: &Camera,
    marker: &flockeye_geometry::body::Marker,
    corner: usize,
    pose: &Isometry3<f64>,
    chance: &mut Chance,
) -> Option<CornerRay> {
    let point = (pose * marker.corners[corner]).coords;
    let direction = Unit::new_normalize(point);
    let noise = Vector3::from(chance.normals::<3>().map(|x| x.clamp(-3.5, 3.5))) * RAY_RAD;
    let pixel = real.at_distance(point.norm()).project(&direction)?;
    let ray = believed.ray(pixel)?;
    // Views are cut as the believed camera sees: next to the seam it may take the other lens.
    let is_cut_from_there = (believed.project(&ray)?.0 - pixel.0).norm() < 1e-3;
    let ray_in_camera = Unit::new_normalize(ray.into_inner() + noise);
    if !is_cut_from_there {
        return None;
    }
    Some(CornerRay { marker_id: marker.id, corner, ray_in_camera, deviation_rad: RAY_RAD })
}

/// A second lens that was glued 3 mm and half a degree off.
fn step(chance: &mut Chance) -> Vector6<f64> {
    let [x, y, z, a, b, c] = chance.normals::<6>();
    Vector6::new(x * 0.003, y * 0.003, z * 0.003, a * 0.005, b * 0.005, c * 0.005)
}

const AROUND: [f64; 2] = [0.0, std::f64::consts::TAU];

/// Squared errors in stated variances, summed over many cameras: six for each of them if these are
/// right.
#[test]
fn the_second_lens_is_found_within_its_covariance() {
    let cameras = 30;
    let mut sum = 0.0;
    for seed in 0..cameras {
        let mut chance = Chance::new(seed);
        let (real, believed) = (fisheyes(&step(&mut chance)), fisheyes(&Vector6::zeros()));
        let frames = recorded(&real, &believed, 150, AROUND, &mut chance);
        let found = calibrate(&believed, &[body()], &frames).unwrap();
        let FoundLenses::Second { camera_from_lens, covariance } = found.found else {
            panic!("{found:?}")
        };
        let left = error(&pose_of_second(&real), &camera_from_lens);
        sum += distance_squared(&left, &covariance);
        assert!(left.fixed_rows::<3>(0).norm() < 3e-4, "seed {seed}: {left}");
        assert!(found.frames >= 30 && found.sides.iter().sum::<usize>() == found.frames);
        assert!((found.scatter - 1.0).abs() < 0.15, "scatter {}", found.scatter);
        assert!(found.scatter_before > 2.0 * found.scatter, "{}", found.scatter_before);
        assert!(found.error_at_m(1.5) < found.configured_error_at_m(1.5) / 4.0, "{found:?}");
        // The change that was found is the error that had been made.
        let changed = error(&pose_of_second(&real), &pose_of_second(&believed));
        assert!((changed - found.change - left).norm() < 1e-4, "{changed} {}", found.change);
    }
    let bound = |share: f64| chi_square_quantile(6.0 * cameras as f64, share);
    assert!((bound(0.001)..bound(0.999)).contains(&sum), "{sum} for {cameras} cameras");
}

#[test]
fn the_distance_between_stitched_lenses_is_found_within_its_deviation() {
    let cameras = 30;
    let mut sum = 0.0;
    for seed in 0..cameras {
        let mut chance = Chance::new(100 + seed);
        let (truth, configured) = (chance.even(0.005, 0.03), chance.even(0.0, 0.02));
        let (real, believed) = (stitched(truth), stitched(configured));
        let frames = recorded(&real, &believed, 120, AROUND, &mut chance);
        let found = calibrate(&believed, &[body()], &frames).unwrap();
        let FoundLenses::Distance { lens_distance_m, deviation_m } = found.found else {
            panic!("{found:?}")
        };
        sum += ((lens_distance_m - truth) / deviation_m).powi(2);
        assert!((lens_distance_m - truth).abs() < 5e-4, "{truth}: {lens_distance_m}");
        // Each lens is off the middle by half of it, wherever the neighbour is.
        let expected = [(lens_distance_m - configured).abs() / 2.0, deviation_m / 2.0];
        let stated = [found.configured_error_at_m(1.5), found.error_at_m(1.5)];
        for (stated, expected) in stated.iter().zip(expected) {
            assert!((stated - expected).abs() < 1e-9, "{stated} {expected}");
        }
    }
    let bound = |share: f64| chi_square_quantile(cameras as f64, share);
    assert!((bound(0.001)..bound(0.999)).contains(&sum), "{sum} for {cameras} cameras");
}

#[test]
fn a_camera_that_is_as_configured_stays_so() {
    let mut chance = Chance::new(7);
    let camera = stitched(0.016);
    let frames = recorded(&camera, &camera, 120, AROUND, &mut chance);
    let found = calibrate(&camera, &[body()], &frames).unwrap();
    assert!(found.change.norm() < 4.0 * found.covariance.trace().sqrt(), "{found:?}");
    assert!((found.scatter_before / found.scatter - 1.0).abs() < 0.02, "{found:?}");
}

#[test]
fn what_is_missing_is_said() {
    let mut chance = Chance::new(8);
    let (real, believed) = (fisheyes(&step(&mut chance)), fisheyes(&Vector6::zeros()));
    let says = |camera: &Camera, frames: &[Vec<CornerRay>]| {
        calibrate(camera, &[body()], frames).unwrap_err().to_string()
    };
    let few = recorded(&real, &believed, 8, AROUND, &mut chance);
    assert!(
        says(&believed, &few).contains("12 are needed. Cure: carry"),
        "{}",
        says(&believed, &few)
    );
    let one =
        Camera::new(1000, 1000, CameraModel::Stereographic { field_rad: 300f64.to_radians() });
    assert_eq!(calibrate(&one.unwrap(), &[body()], &few).unwrap_err(), CalibrationError::OneCentre);
    // Rays too rough to tell, at one place of the seam only.
    let mut rough = recorded(&real, &believed, 120, [0.0, 0.1], &mut chance);
    for ray in rough.iter_mut().flatten() {
        let noise = Vector3::from(chance.normals::<3>()) * 6e-3;
        ray.deviation_rad = 6e-3;
        ray.ray_in_camera = Unit::new_normalize(ray.ray_in_camera.into_inner() + noise);
    }
    let said = says(&believed, &rough);
    assert!(said.contains("at several places round it"), "{said}");
}

#[test]
fn a_misread_marker_across_the_seam_is_outweighed() {
    let mut chance = Chance::new(11);
    let (real, believed) = (stitched(0.018), stitched(0.0));
    let mut frames = recorded(&real, &believed, 120, AROUND, &mut chance);
    // One corner in thirty is off by ten deviations.
    for (k, ray) in frames.iter_mut().flatten().enumerate().filter(|(k, _)| k % 30 == 0) {
        let aside = Vector3::ith(k % 3, 10.0 * RAY_RAD);
        ray.ray_in_camera = Unit::new_normalize(ray.ray_in_camera.into_inner() + aside);
    }
    let found = calibrate(&believed, &[body()], &frames).unwrap();
    let FoundLenses::Distance { lens_distance_m, .. } = found.found else { panic!("{found:?}") };
    assert!((lens_distance_m - 0.018).abs() < 5e-4, "{lens_distance_m}");
}

#[test]
fn frames_in_which_the_lenses_see_two_things_are_left_out() {
    let mut chance = Chance::new(12);
    let (real, believed) = (stitched(0.018), stitched(0.01));
    let mut frames = recorded(&real, &believed, 120, AROUND, &mut chance);
    // In some frames what is behind has moved on, as when two pictures are of two times.
    for frame in frames.iter_mut().step_by(10) {
        for ray in frame.iter_mut().filter(|ray| ray.ray_in_camera.x < 0.0) {
            let turn = UnitQuaternion::from_scaled_axis(Vector3::x() * 0.05);
            ray.ray_in_camera = turn * ray.ray_in_camera;
        }
    }
    let found = calibrate(&believed, &[body()], &frames).unwrap();
    assert!((2..=12).contains(&found.left_out), "{found:?}");
    let FoundLenses::Distance { lens_distance_m, .. } = found.found else { panic!("{found:?}") };
    assert!((lens_distance_m - 0.018).abs() < 5e-4, "{lens_distance_m}");
    assert!((found.scatter - 1.0).abs() < 0.15, "{found:?}");
}
