//! Frames of a world that is drawn from formulas, so that its rotation is exact.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use flockeye_geometry::camera::{Camera, SpherePixel};
use flockeye_geometry::mask::Mask;
use nalgebra::Vector3;
use proptest::prelude::*;

use super::*;

const WIDTH: u32 = 960;

fn camera() -> Camera {
    Camera::equirectangular(WIDTH, WIDTH / 2)
}

fn gyroscope() -> Gyroscope {
    Gyroscope::new(Sampler::new(&camera(), &Mask::nothing_hidden(camera())))
}

/// The value that the world shows in a direction: waves of many lengths.
fn world(direction: &Vector3<f64>) -> f64 {
    let waves = (0..24).map(|k| {
        let of = |n: u32| f64::from((k * 7919 + n * 104_729) % 1000) / 500.0 - 1.0;
        let wave = Vector3::new(of(1), of(2), of(3)) * (3.0 + f64::from(k));
        (wave.dot(direction) + of(4) * 3.0).sin()
    });
    128.0 + 12.0 * waves.sum::<f64>()
}

/// A frame of the world, with `camera_from_world`; `own` says what the drone shows of itself.
fn frame(
    camera_from_world: &UnitQuaternion<f64>,
    own: impl Fn(&Vector3<f64>) -> Option<f64>,
) -> Vec<u8> {
    let camera = camera();
    (0..WIDTH * WIDTH / 2)
        .map(|k| {
            let pixel = SpherePixel::new(f64::from(k % WIDTH), f64::from(k / WIDTH));
            let ray = camera.ray(pixel).unwrap();
            let value = own(&ray).unwrap_or_else(|| world(&(camera_from_world.inverse() * *ray)));
            value.round().clamp(0.0, 255.0) as u8
        })
        .collect()
}

fn next(gyroscope: &mut Gyroscope, pixels: &[u8]) -> Option<Turned> {
    let image = SphereImage::new(pixels, WIDTH as usize, camera()).unwrap();
    gyroscope.next(&image, None)
}

fn nothing_of_itself(_: &Vector3<f64>) -> Option<f64> {
    None
}

fn error_deg(found: &Turned, truth: &UnitQuaternion<f64>) -> f64 {
    found.later_from_earlier.angle_to(truth).to_degrees()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(6))]

    #[test]
    fn any_turn_of_up_to_five_degrees_is_found(
        axis in prop::array::uniform3(-1.0..1.0f64),
        degrees in 0.0..5.0f64,
        attitude in prop::array::uniform3(-3.0..3.0f64),
    ) {
        prop_assume!(Vector3::from(axis).norm() > 0.1);
        let turn = UnitQuaternion::from_scaled_axis(
            Vector3::from(axis).normalize() * degrees.to_radians(),
        );
        let first = UnitQuaternion::from_scaled_axis(Vector3::from(attitude));
        let mut gyroscope = gyroscope();
        prop_assert!(next(&mut gyroscope, &frame(&first, nothing_of_itself)).is_none());
        let found = next(&mut gyroscope, &frame(&(turn * first), nothing_of_itself)).unwrap();
        let error = error_deg(&found, &turn);
        prop_assert!(error < 0.02, "{error} degrees");
        let sigma = found.covariance.trace().sqrt().to_degrees();
        prop_assert!(error < 4.0 * sigma + 0.003, "{error} degrees where {sigma} are stated");
    }
}

#[test]
fn a_turn_that_something_else_knows_is_found_however_large() {
    let turn = UnitQuaternion::from_euler_angles(0.2, -0.3, 0.5);
    let wrong = UnitQuaternion::from_euler_angles(0.01, 0.02, -0.01);
    let mut gyroscope = gyroscope();
    next(&mut gyroscope, &frame(&UnitQuaternion::identity(), nothing_of_itself));
    let later = frame(&turn, nothing_of_itself);
    let image = SphereImage::new(&later, WIDTH as usize, camera()).unwrap();
    let found = gyroscope.next(&image, Some(wrong * turn)).unwrap();
    assert!(error_deg(&found, &turn) < 0.02, "{}", error_deg(&found, &turn));
}

#[test]
fn an_expectation_that_is_far_off_does_no_harm() {
    // A clock that jumped by a quarter of a second expects twelve degrees where two were turned.
    let turn = UnitQuaternion::from_euler_angles(0.01, -0.015, 0.03);
    let mut gyroscope = gyroscope();
    let mut attitude = UnitQuaternion::identity();
    next(&mut gyroscope, &frame(&attitude, nothing_of_itself));
    for expected in [None, Some(turn), Some(turn.powf(6.0)), Some(turn)] {
        attitude = turn * attitude;
        let pixels = frame(&attitude, nothing_of_itself);
        let image = SphereImage::new(&pixels, WIDTH as usize, camera()).unwrap();
        let found = gyroscope.next(&image, expected).unwrap();
        assert!(error_deg(&found, &turn) < 0.02, "{} degrees", error_deg(&found, &turn));
    }
}

#[test]
fn a_change_of_brightness_is_no_turn() {
    let mut gyroscope = gyroscope();
    let attitude = UnitQuaternion::from_euler_angles(0.1, 0.2, 0.3);
    let turn = UnitQuaternion::from_euler_angles(0.01, -0.02, 0.015);
    next(&mut gyroscope, &frame(&attitude, nothing_of_itself));
    let darker: Vec<u8> = frame(&(turn * attitude), nothing_of_itself)
        .into_iter()
        .map(|value| (f64::from(value) * 0.8 - 6.0).round() as u8)
        .collect();
    let found = next(&mut gyroscope, &darker).unwrap();
    assert!(error_deg(&found, &turn) < 0.02, "{}", error_deg(&found, &turn));
}

#[test]
fn without_texture_it_does_not_know_and_goes_on_afterwards() {
    let mut gyroscope = gyroscope();
    let turn = UnitQuaternion::from_euler_angles(0.0, 0.01, 0.02);
    let mut attitude = UnitQuaternion::identity();
    next(&mut gyroscope, &frame(&attitude, nothing_of_itself));
    for value in [0, 255, 128] {
        let plain = vec![value; (WIDTH * WIDTH / 2) as usize];
        assert!(next(&mut gyroscope, &plain).is_none(), "all {value}");
    }
    assert!(next(&mut gyroscope, &frame(&attitude, nothing_of_itself)).is_none());
    attitude = turn * attitude;
    let found = next(&mut gyroscope, &frame(&attitude, nothing_of_itself)).unwrap();
    assert!(error_deg(&found, &turn) < 0.02);
}

#[test]
fn the_drone_itself_is_learned_and_left_out() {
    let mut gyroscope = gyroscope();
    // A fifth of the sphere: a hull with texture of its own, which turns with the camera.
    let own = |ray: &Vector3<f64>| {
        (ray.x > 0.6).then(|| 60.0 + 50.0 * ((17.0 * ray.z).sin() * (23.0 * ray.y).sin()))
    };
    let turn = UnitQuaternion::from_euler_angles(0.015, -0.01, 0.04);
    let mut attitude = UnitQuaternion::identity();
    let mut last = 0.0;
    for _ in 0..16 {
        if let Some(found) = next(&mut gyroscope, &frame(&attitude, own)) {
            last = error_deg(&found, &turn);
        }
        attitude = turn * attitude;
    }
    assert!(last < 0.03, "{last} degrees");
    let hidden = gyroscope.airframe.iter().filter(|cell| cell.is_airframe()).count();
    let share = hidden as f64 / CELLS as f64;
    assert!((0.1..0.35).contains(&share), "{share} of the cells");
}

#[test]
fn any_camera_is_averaged_alike() {
    // Not a multiple of the grid: looked up instead of averaged in blocks.
    let (of, other) = (camera(), Camera::equirectangular(1000, 500));
    let image = |camera: Camera| -> Vec<u8> {
        let width = camera.width();
        let ray = |k: u32| {
            let (u, v) = (f64::from(k % width), f64::from(k / width));
            camera.ray(SpherePixel::new(u, v)).unwrap()
        };
        (0..width * width / 2).map(|k| world(&ray(k)).round() as u8).collect()
    };
    let level = |camera: Camera| {
        let pixels = image(camera);
        let frame = SphereImage::new(&pixels, camera.width() as usize, camera).unwrap();
        Sampler::new(&camera, &Mask::nothing_hidden(camera)).pyramid(&frame).swap_remove(0)
    };
    let (left, right) = (level(of), level(other));
    let worst = (0..grid::COLUMNS * grid::rows_read())
        .map(|pixel| (left.at(pixel) - right.at(pixel)).abs())
        .fold(0.0, f32::max);
    assert!(worst < 4.0, "{worst} of 256 code values");
}
