//! Benchmarks of a frame: 3840x1920 with one and four bodies, other cameras with four.

#![allow(clippy::expect_used)]

use criterion::{Criterion, criterion_group, criterion_main};
use flockeye_dictionary::Dictionary;
use flockeye_geometry::body::{Bodies, squares};
use flockeye_geometry::camera::{Camera, CameraModel, Lens};
use flockeye_simulator::{Attitude, Moment, Placement, World, WorldParameters};
use nalgebra::{Isometry3, Rotation3, UnitQuaternion, Vector3};

/// Bodies all round the camera at `distance` metres, each with a sideways velocity of 0.5 m/s.
fn ring(count: u32, distance: f64) -> Moment {
    let placements = (0..count).map(|k| {
        let (sin, cos) = (f64::from(k) * std::f64::consts::TAU / f64::from(count)).sin_cos();
        Placement {
            camera_from_markers: Isometry3::translation(distance * cos, distance * sin, 0.1),
            velocity_in_camera: Vector3::new(-sin, cos, 0.3) * 0.5,
        }
    });
    Moment { time_s: 0.0, camera: Attitude::level(0.7), placements: placements.collect() }
}

fn world(count: u32, camera: Camera) -> World {
    let bodies = (0..count).map(|k| squares(&format!("body{k}"), 0.0625, 0.05, 17 * k));
    let bodies = Bodies::new("DICT_5X5_250".into(), bodies.collect()).expect("apart");
    let parameters = WorldParameters { camera, ..Default::default() };
    let dictionary = Dictionary::of(&bodies).expect("OpenCV's own");
    World::new(parameters, &bodies, &dictionary).expect("a world")
}

/// Two equidistant lenses of 190 degrees, 16 mm apart; their circles fill an image of aspect 2:1.
fn fisheyes(width: u32) -> Camera {
    let side = f64::from(width) / 2.0;
    let lens = |ahead: f64, middle: f64| {
        let axes = [-Vector3::y() * ahead, -Vector3::z(), Vector3::x() * ahead];
        let rotation = Rotation3::from_basis_unchecked(&axes);
        let position = Vector3::x() * (0.008 * ahead);
        let pose =
            Isometry3::from_parts(position.into(), UnitQuaternion::from_rotation_matrix(&rotation));
        let centre = [middle - 0.5, side / 2.0 - 0.5].into();
        Lens::equidistant(pose, centre, side / 2.0, 190f64.to_radians())
    };
    let lenses = [lens(1.0, side / 2.0), lens(-1.0, 1.5 * side)];
    Camera::new(width, width / 2, CameraModel::DualFisheye(lenses)).expect("a camera")
}

fn other_cameras(criterion: &mut Criterion) {
    let stitched = CameraModel::Equirectangular { lens_distance_m: 0.016 };
    let plane = CameraModel::Stereographic { field_rad: 240f64.to_radians() };
    let cameras = [
        ("fisheyes 1920x960", fisheyes(1920)),
        ("fisheyes 3840x1920", fisheyes(3840)),
        ("plane 1280x1280", Camera::new(1280, 1280, plane).expect("a camera")),
        ("stitched 3840x1920", Camera::new(3840, 1920, stitched).expect("a camera")),
    ];
    for (name, camera) in cameras {
        let mut world = world(4, camera);
        let width = camera.width() as usize;
        let mut luma = vec![0; width * camera.height() as usize];
        let moment = ring(4, 1.0);
        let mut frame = 0;
        criterion.bench_function(&format!("{name}, 4 at 1 m"), |bencher| {
            bencher.iter(|| {
                frame += 1;
                world.render_moment(frame, &moment, &mut luma, width).expect("a frame")
            });
        });
    }
}

/// An observer in gusts: the backdrop is averaged along the path of each pixel.
fn in_gusts(criterion: &mut Criterion) {
    let body = squares("body0", 0.0625, 0.05, 0);
    let bodies = Bodies::new("DICT_5X5_250".into(), vec![body]).expect("one");
    let parameters = WorldParameters {
        tilt_deg: 15.0,
        yaw_swing_deg_s: 60.0,
        exposure_s: 0.01,
        distance_m: [1.0, 2.0],
        ..Default::default()
    };
    let dictionary = Dictionary::of(&bodies).expect("OpenCV's own");
    let mut world = World::new(parameters, &bodies, &dictionary).expect("a world");
    let mut luma = vec![0; 3840 * 1920];
    let mut frame = 0;
    criterion.bench_function("1 in gusts", |bencher| {
        bencher.iter(|| {
            frame += 1;
            world.render(frame, &mut luma, 3840).expect("a frame")
        });
    });
}

fn render(criterion: &mut Criterion) {
    for count in [1, 4] {
        let mut world = world(count, Camera::equirectangular(3840, 1920));
        let mut luma = vec![0; 3840 * 1920];
        for distance in [0.6, 1.0, 2.0] {
            let moment = ring(count, distance);
            let mut frame = 0;
            criterion.bench_function(&format!("{count} at {distance} m"), |bencher| {
                bencher.iter(|| {
                    frame += 1;
                    world.render_moment(frame, &moment, &mut luma, 3840).expect("a frame")
                });
            });
        }
    }
}

criterion_group!(benches, render, in_gusts, other_cameras);
criterion_main!(benches);
