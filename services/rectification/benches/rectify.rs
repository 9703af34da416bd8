//! Views from a 3840x1920 frame: our back ends, and OpenCV's remap with fixed-point maps that
//! were prepared beforehand (what a view that moves cannot have).
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use criterion::{Criterion, criterion_group, criterion_main};
use flockeye_geometry::camera::Camera;
use flockeye_geometry::view::{View, ViewPixel};
use flockeye_imaging::sphere::{Cut, SphereImage};
use flockeye_rectification::cpu::CpuRectifier;
use flockeye_rectification::gpu::{FoundAdapter, GpuRectifier};
use flockeye_rectification::rectifier::Rectifier;
use nalgebra::{Unit, Vector3};
use opencv::core::{self, CV_16SC2, CV_32FC1, Mat, Scalar};
use opencv::imgproc;
use opencv::prelude::*;

const CAMERA: Camera = Camera::equirectangular(3840, 1920);
const FIELD_DEG: f64 = 74.75;
const SIZE_PX: u32 = 936;

/// Texture at every scale, so that no row is like the next.
fn frame() -> Vec<u8> {
    (0..CAMERA.width() * CAMERA.height())
        .map(|k| {
            let (x, y) = (k % CAMERA.width(), k / CAMERA.width());
            (x.wrapping_mul(y).wrapping_add((x / 7) ^ (y / 5)) >> 3) as u8
        })
        .collect()
}

fn look(direction: Vector3<f64>, field_deg: f64, size_px: u32) -> View {
    View::looking_at(&Unit::new_normalize(direction), field_deg.to_radians(), size_px)
}

/// The vertices of an icosahedron, about which twelve circles cover the sphere best.
fn partition() -> Vec<View> {
    let golden = (1.0 + 5f64.sqrt()) / 2.0;
    let mut directions = Vec::new();
    for one in [-1.0, 1.0] {
        for long in [-golden, golden] {
            directions.push(Vector3::new(0.0, one, long));
            directions.push(Vector3::new(one, long, 0.0));
            directions.push(Vector3::new(long, 0.0, one));
        }
    }
    directions.into_iter().map(|direction| look(direction, FIELD_DEG, SIZE_PX)).collect()
}

fn cut(
    rectifier: &mut dyn Rectifier,
    sphere: &SphereImage<'_>,
    views: &[View],
    out: &mut [Vec<u8>],
) {
    let mut slices: Vec<&mut [u8]> = out.iter_mut().map(Vec::as_mut_slice).collect();
    let cuts: Vec<Cut> = views.iter().copied().map(Cut::bilinear).collect();
    rectifier.cut(sphere, &cuts, &mut slices).unwrap();
}

fn buffers(views: &[View]) -> Vec<Vec<u8>> {
    views.iter().map(|view| vec![0; view.size_px.pow(2) as usize]).collect()
}

fn processor(criterion: &mut Criterion) {
    let pixels = frame();
    let sphere = SphereImage::new(&pixels, 3840, CAMERA).unwrap();
    let mut group = criterion.benchmark_group("cpu");
    let one = [
        ("partition view, 1 thread", look(Vector3::new(1.0, 0.3, 0.2), FIELD_DEG, SIZE_PX)),
        ("partition view on the seam, 1 thread", look(-Vector3::x(), FIELD_DEG, SIZE_PX)),
        ("partition view on the pole, 1 thread", look(Vector3::z(), FIELD_DEG, SIZE_PX)),
    ];
    for (name, view) in one {
        let mut out = buffers(&[view]);
        let mut cpu = CpuRectifier::new(1);
        group.bench_function(name, |b| b.iter(|| cut(&mut cpu, &sphere, &[view], &mut out)));
    }
    group.bench_function("gaze view 20 deg 400 px, moving, 1 thread", |b| {
        let mut cpu = CpuRectifier::new(1);
        let mut out = buffers(&[look(Vector3::x(), 20.0, 400)]);
        let mut azimuth = 0f64;
        b.iter(|| {
            azimuth += 0.01;
            let direction = Vector3::new(azimuth.cos(), azimuth.sin(), 0.2);
            cut(&mut cpu, &sphere, &[look(direction, 20.0, 400)], &mut out);
        });
    });
    let views = partition();
    let mut out = buffers(&views);
    for threads in [1, 2] {
        let mut cpu = CpuRectifier::new(threads);
        let name = format!("12 partition views, {threads} threads");
        group.bench_function(name, |b| b.iter(|| cut(&mut cpu, &sphere, &views, &mut out)));
    }
}

fn graphics(criterion: &mut Criterion) {
    let found = match FoundAdapter::best() {
        Ok(found) => found,
        Err(error) => return println!("gpu: skipped: {error}"),
    };
    let mut gpu = GpuRectifier::open(found).unwrap();
    println!("{}", gpu.name());
    let pixels = frame();
    let sphere = SphereImage::new(&pixels, 3840, CAMERA).unwrap();
    let mut group = criterion.benchmark_group("gpu");
    gpu.begin_frame(&sphere).unwrap();
    let view = look(Vector3::new(1.0, 0.3, 0.2), FIELD_DEG, SIZE_PX);
    let mut out = buffers(&[view]);
    group.bench_function("partition view, frame uploaded before", |b| {
        b.iter(|| cut(&mut gpu, &sphere, &[view], &mut out));
    });
    let views = partition();
    let mut out = buffers(&views);
    group.sample_size(20);
    group.bench_function("12 partition views, with the upload", |b| {
        b.iter(|| {
            gpu.begin_frame(&sphere).unwrap();
            cut(&mut gpu, &sphere, &views, &mut out);
        });
    });
}

/// OpenCV's fixed-point maps of a view.
fn maps(view: &View) -> (Mat, Mat) {
    let size = view.size_px as i32;
    let new = || Mat::new_rows_cols_with_default(size, size, CV_32FC1, Scalar::all(0.0)).unwrap();
    let (mut columns, mut rows) = (new(), new());
    for y in 0..size {
        for x in 0..size {
            let ray = view.ray(ViewPixel::new(f64::from(x), f64::from(y)));
            let at = CAMERA.project(&ray).unwrap().0;
            *columns.at_2d_mut::<f32>(y, x).unwrap() = at.x as f32;
            *rows.at_2d_mut::<f32>(y, x).unwrap() = at.y as f32;
        }
    }
    let (mut whole, mut fraction) = (Mat::default(), Mat::default());
    imgproc::convert_maps(&columns, &rows, &mut whole, &mut fraction, CV_16SC2, false).unwrap();
    (whole, fraction)
}

fn opencv_remap(criterion: &mut Criterion) {
    core::set_num_threads(1).unwrap();
    let pixels = frame();
    let sphere = Mat::from_slice(&pixels).unwrap();
    let sphere = sphere.reshape(1, CAMERA.height() as i32).unwrap();
    let mut group = criterion.benchmark_group("opencv remap, fixed-point maps prepared");
    let mut remap = |name: &str, view: View| {
        let (whole, fraction) = maps(&view);
        group.bench_function(name, |b| {
            let mut out = Mat::default();
            let (mode, border) = (imgproc::INTER_LINEAR, core::BORDER_WRAP);
            b.iter(|| {
                let fill = Scalar::default();
                imgproc::remap(&sphere, &mut out, &whole, &fraction, mode, border, fill).unwrap();
            });
        });
    };
    remap("partition view, 1 thread", look(Vector3::new(1.0, 0.3, 0.2), FIELD_DEG, SIZE_PX));
    remap("partition view on the pole, 1 thread", look(Vector3::z(), FIELD_DEG, SIZE_PX));
    remap("gaze view 20 deg 400 px, 1 thread", look(Vector3::new(1.0, 0.3, 0.2), 20.0, 400));
}

criterion_group!(benches, processor, opencv_remap, graphics);
criterion_main!(benches);
