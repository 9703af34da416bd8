//! The cost of aligning a tracked body from its predicted pose, by distance.

#![allow(clippy::unwrap_used, clippy::expect_used)]

#[path = "../tests/drawn_body/mod.rs"]
mod drawn_body;

use criterion::{Criterion, criterion_group, criterion_main};
use flockeye_geometry::body::squares;
use flockeye_imaging::align::{AlignOptions, BodyPrint, Picture, align};
use flockeye_imaging::light::{CodeRange, LinearLight, TransferCurve};
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};

const PIXELS_PER_RADIAN: f64 = 611.0;

fn tracked(criterion: &mut Criterion) {
    let body = squares("alpha", 0.0625, 0.05, 0);
    let prints = drawn_body::prints();
    let print = BodyPrint::new(&body, |id| prints.get(&id)).expect("all are there");
    let light = LinearLight::new(TransferCurve::Srgb, CodeRange::Full).expect("a curve");
    let mut group = criterion.benchmark_group("align a tracked body");
    for range_m in [0.5, 1.0, 1.5, 2.0, 3.0] {
        let truth = Isometry3::from_parts(
            Translation3::from(Vector3::new(0.8, 0.5, 0.33).normalize() * range_m),
            UnitQuaternion::from_euler_angles(0.3, -0.2, 0.9),
        );
        // Like the region of interest of a tracked body: magnified until a marker has 80 px, three
        // times at most.
        let magnification = (80.0 / (0.05 / range_m * PIXELS_PER_RADIAN)).clamp(1.0, 3.0);
        let drawing = drawn_body::draw(
            &body,
            &truth,
            PIXELS_PER_RADIAN * magnification,
            0.9 * magnification,
            0.004,
        );
        let start = Isometry3::from_parts(
            Translation3::from(truth.translation.vector * 1.002 + Vector3::new(0.0, 0.0, 3e-4)),
            UnitQuaternion::from_euler_angles(0.003, 0.002, -0.003) * truth.rotation,
        );
        let options = AlignOptions::default();
        let picture = Picture::still(drawing.image(), drawing.view, &light, PIXELS_PER_RADIAN);
        let run = || align(&print, &picture, &start, &options).expect("there");
        group.bench_function(format!("{range_m} m"), |bencher| bencher.iter(run));
    }
    group.finish();
}

criterion_group!(benches, tracked);
criterion_main!(benches);
