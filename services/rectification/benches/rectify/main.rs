//! Benchmarks of views: our back ends, and OpenCV's remap with maps built before or in each call.
//! Moving views need new maps each time. The output ends with a table of ratios.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

mod maps;
mod ratios;
mod scene;

use criterion::{Criterion, criterion_group};
use flockeye_imaging::sphere::Cut;
use flockeye_rectification::cpu::CpuRectifier;
use flockeye_rectification::gpu::{FoundAdapter, GpuRectifier};
use flockeye_rectification::rectifier::Rectifier as _;
use nalgebra::Vector3;

use self::scene::{Scene, buffer, equirectangular, look, partition, region};

fn processor(criterion: &mut Criterion) {
    let scene = Scene::of(equirectangular());
    let mut group = criterion.benchmark_group("cpu, 1 thread");
    let ahead = look(Vector3::new(1.0, 0.3, 0.2), 74.75, 936);
    let views = [
        ("partition view", Cut::bilinear(ahead)),
        ("partition view on the seam", Cut::bilinear(look(-Vector3::x(), 74.75, 936))),
        ("partition view on the pole", Cut::bilinear(look(Vector3::z(), 74.75, 936))),
        ("partition view, cubic", Cut::cubic(ahead)),
        ("region of interest 20 deg 400 px, cubic", Cut::cubic(region(0))),
    ];
    for (name, cut) in views {
        let mut cpu = CpuRectifier::new(1);
        let mut out = buffer(&cut.view);
        group.bench_function(name, |b| b.iter(|| scene.cut(&mut cpu, 0, &cut, &mut out)));
    }
}

fn graphics(criterion: &mut Criterion) {
    let found = match FoundAdapter::best() {
        Ok(found) => found,
        Err(error) => return println!("gpu: skipped: {error}"),
    };
    let mut gpu = GpuRectifier::open(found).unwrap();
    println!("{}", gpu.name());
    let scene = Scene::of(equirectangular());
    let mut group = criterion.benchmark_group("gpu");
    group.sample_size(20);
    let mut frame = 0;
    group.bench_function("upload", |b| {
        b.iter(|| {
            frame += 1;
            gpu.prepare(scene.key(frame), &scene.sphere()).unwrap();
        });
    });
    let cuts: Vec<_> = partition().into_iter().map(Cut::bilinear).collect();
    let mut out = buffer(&cuts[0].view);
    group.bench_function("12 partition views of a frame, upload and readback", |b| {
        b.iter(|| {
            frame += 1;
            gpu.order(scene.key(frame), &scene.sphere(), &cuts).unwrap();
            for cut in &cuts {
                scene.cut(&mut gpu, frame, cut, &mut out);
            }
        });
    });
}

criterion_group!(benches, processor, graphics);

fn main() {
    benches();
    Criterion::default().configure_from_args().final_summary();
    // `cargo test` runs each benchmark once, without this argument.
    if std::env::args().any(|argument| argument == "--bench") {
        ratios::print();
    }
}
