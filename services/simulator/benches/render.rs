//! What a frame of 3840x1920 costs, with one body and with four.

#![allow(clippy::expect_used)]

use criterion::{Criterion, criterion_group, criterion_main};
use flockeye_geometry::body::{Bodies, squares};
use flockeye_simulator::{Moment, PatternBook, Placement, World, WorldParameters};
use nalgebra::{Isometry3, Vector3};

/// Bodies all round at `distance` metres, each moving sideways at half a metre per second.
fn ring(count: u32, distance: f64) -> Moment {
    let placements = (0..count).map(|k| {
        let (sin, cos) = (f64::from(k) * std::f64::consts::TAU / f64::from(count)).sin_cos();
        Placement {
            camera_from_markers: Isometry3::translation(distance * cos, distance * sin, 0.1),
            velocity_in_camera: Vector3::new(-sin, cos, 0.3) * 0.5,
        }
    });
    Moment { time_s: 0.0, observer_yaw: 0.7, placements: placements.collect() }
}

fn render(criterion: &mut Criterion) {
    for count in [1, 4] {
        let bodies = (0..count).map(|k| squares(&format!("body{k}"), 0.0625, 0.05, 17 * k));
        let bodies = Bodies::new("DICT_5X5_250".into(), bodies.collect()).expect("apart");
        let mut world =
            World::new(WorldParameters::default(), &bodies, &PatternBook::dict_5x5_250())
                .expect("a world");
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

criterion_group!(benches, render);
criterion_main!(benches);
