//! The cost of the visual gyroscope for each frame at 3840x1920, and where it goes.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use criterion::{Criterion, criterion_group, criterion_main};
use flockeye_geometry::camera::{Camera, SpherePixel};
use flockeye_geometry::mask::Mask;
use flockeye_imaging::gyroscope::Gyroscope;
use flockeye_imaging::gyroscope::grid::{CELLS, Sampler};
use flockeye_imaging::gyroscope::own_airframe::AirframeCell;
use flockeye_imaging::gyroscope::points::points_of;
use flockeye_imaging::gyroscope::solve::rotation;
use flockeye_imaging::sphere::SphereImage;
use nalgebra::{UnitQuaternion, Vector3};

const WIDTH: u32 = 3840;

/// What a camera shows of a world of waves of many lengths.
fn frame(camera: Camera, camera_from_world: &UnitQuaternion<f64>) -> Vec<u8> {
    let waves: Vec<(Vector3<f32>, f32)> = (0..24u32)
        .map(|k| {
            let of = |n: u32| ((k * 7919 + n * 104_729) % 1000) as f32 / 500.0 - 1.0;
            (Vector3::new(of(1), of(2), of(3)) * (3.0 + 2.0 * k as f32), of(4) * 3.0)
        })
        .collect();
    let world_from_camera = camera_from_world.inverse();
    let value = |k: u32| {
        let pixel = SpherePixel::new(f64::from(k % WIDTH), f64::from(k / WIDTH));
        let direction = (world_from_camera * *camera.ray(pixel).unwrap()).cast::<f32>();
        let light: f32 =
            waves.iter().map(|(wave, start)| (wave.dot(&direction) + start).sin()).sum();
        (128.0 + 12.0 * light).round().clamp(0.0, 255.0) as u8
    };
    (0..WIDTH * WIDTH / 2).map(value).collect()
}

fn each_frame(criterion: &mut Criterion) {
    let camera = Camera::equirectangular(WIDTH, WIDTH / 2);
    let sampler = Sampler::new(&camera, &Mask::nothing_hidden(camera));
    let turn = UnitQuaternion::from_euler_angles(0.01, -0.015, 0.02);
    let pixels = [frame(camera, &UnitQuaternion::identity()), frame(camera, &turn)];
    let images =
        pixels.each_ref().map(|pixels| SphereImage::new(pixels, WIDTH as usize, camera).unwrap());
    let pyramids = images.each_ref().map(|image| sampler.pyramid(image));
    let points: Vec<_> = pyramids[0].iter().map(|level| points_of(level, &sampler)).collect();
    let airframe = vec![AirframeCell::default(); CELLS];

    let mut group = criterion.benchmark_group("visual gyroscope");
    group.bench_function("average", |bencher| bencher.iter(|| sampler.pyramid(&images[0])));
    group.bench_function("points", |bencher| {
        bencher.iter(|| {
            pyramids[0].iter().map(|level| points_of(level, &sampler).len()).sum::<usize>()
        });
    });
    let nearly = UnitQuaternion::from_euler_angles(0.002, 0.001, -0.002) * turn;
    let run =
        |expected, last| rotation(&points, &pyramids[1], expected, last, &airframe).expect("found");
    let name = format!("rotation of {} points", points[0].len());
    group.bench_function(name, |bencher| {
        bencher.iter(|| run(Some(nearly), UnitQuaternion::identity()));
    });
    group.bench_function("rotation that nothing expects", |bencher| {
        bencher.iter(|| run(None, nearly));
    });
    // Forth and back, as expected within a fraction of a degree.
    let expected = [nearly.inverse(), nearly];
    let mut gyroscope = Gyroscope::new(sampler.clone());
    gyroscope.next(&images[0], None);
    let mut at = 0;
    group.bench_function("whole frame", |bencher| {
        bencher.iter(|| {
            at = 1 - at;
            gyroscope.next(&images[at], Some(expected[at])).expect("found")
        });
    });
    group.finish();
}

criterion_group!(benches, each_frame);
criterion_main!(benches);
