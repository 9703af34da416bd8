//! Both back ends give the same views.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use flockeye_geometry::camera::Camera;
use flockeye_geometry::view::View;
use flockeye_imaging::sphere::{Cut, SphereImage};
use flockeye_rectification::cpu::CpuRectifier;
use flockeye_rectification::gpu::{FoundAdapter, GpuRectifier};
use flockeye_rectification::rectifier::{Rectifier, RectifyError};
use nalgebra::{Unit, UnitQuaternion, Vector3};

/// Waves of about 6 px with full contrast, and a stride that ends no row on a whole word.
fn frame(camera: Camera, stride: usize) -> Vec<u8> {
    let mut pixels = vec![0; stride * (camera.height() as usize - 1) + camera.width() as usize];
    for (k, pixel) in pixels.iter_mut().enumerate() {
        let (x, y) = ((k % stride) as f64, (k / stride) as f64);
        // Whole waves around the sphere: nothing jumps at the seam.
        let turn = x / f64::from(camera.width()) * std::f64::consts::TAU;
        let wave = (turn * f64::from(camera.width() / 6)).sin() * (y * 1.05).sin();
        *pixel = (127.5 + 127.0 * wave) as u8;
    }
    pixels
}

fn views() -> Vec<View> {
    let directions = [
        (1.0, 0.2, 0.1),
        (0.0, 0.0, 1.0),
        (0.1, 0.05, -1.0),
        (-1.0, 0.0, 0.2),
        (-1.0, 0.001, 1.0),
        (0.3, -1.0, -0.6),
    ];
    let mut views = Vec::new();
    for (k, (x, y, z)) in directions.into_iter().enumerate() {
        let direction = Unit::new_normalize(Vector3::new(x, y, z));
        for (field, size) in [(4.0, 63), (20.0, 200), (74.75, 331), (110.0, 414)] {
            let mut view = View::looking_at(&direction, f64::to_radians(field), size);
            let roll = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), k as f64 * 0.7);
            view.camera_from_view *= roll;
            views.push(view);
        }
    }
    views
}

fn gpu() -> Option<GpuRectifier> {
    match FoundAdapter::best() {
        Ok(found) => Some(GpuRectifier::open(found).unwrap()),
        Err(error) => {
            println!("skipped: {error}");
            None
        }
    }
}

fn cut(rectifier: &mut dyn Rectifier, sphere: &SphereImage<'_>, views: &[View]) -> Vec<Vec<u8>> {
    let mut outputs: Vec<_> = views.iter().map(|v| vec![0; v.size_px.pow(2) as usize]).collect();
    let mut slices: Vec<&mut [u8]> = outputs.iter_mut().map(Vec::as_mut_slice).collect();
    let cuts: Vec<Cut> = views.iter().copied().map(Cut::bilinear).collect();
    rectifier.cut(sphere, &cuts, &mut slices).unwrap();
    outputs
}

#[test]
fn views_differ_by_two_greys_at_most_and_seldom_by_one() {
    let Some(mut gpu) = gpu() else { return };
    let mut cpu = CpuRectifier::new(2);
    for (camera, stride) in [
        (Camera::equirectangular(1920, 960), 1923),
        (Camera::equirectangular(3840, 1920), 3840),
        // Shorter than the one before: the buffers stay long.
        (Camera::equirectangular(958, 479), 958),
    ] {
        let pixels = frame(camera, stride);
        let sphere = SphereImage::new(&pixels, stride, camera).unwrap();
        gpu.begin_frame(&sphere).unwrap();
        cpu.begin_frame(&sphere).unwrap();
        let views = views();
        let ours = cut(&mut cpu, &sphere, &views);
        // All at once, and the last alone: a frame is uploaded once for many calls.
        let theirs = cut(&mut gpu, &sphere, &views);
        assert_eq!(cut(&mut gpu, &sphere, &views[23..])[0], theirs[23]);
        for (view, (ours, theirs)) in views.iter().zip(ours.iter().zip(&theirs)) {
            let differences = ours.iter().zip(theirs).map(|(a, b)| a.abs_diff(*b));
            let most = differences.clone().max().unwrap();
            let sum: u32 = differences.map(u32::from).sum();
            assert!(most <= 2, "{camera:?} {view:?}: {most}");
            assert!(f64::from(sum) / (ours.len() as f64) < 0.2, "{camera:?} {view:?}: sum {sum}");
        }
    }
}

#[test]
fn only_the_frame_begun_is_cut() {
    let Some(mut gpu) = gpu() else { return };
    let pixels = vec![1; 64 * 32];
    let sphere = SphereImage::new(&pixels, 64, Camera::equirectangular(64, 32)).unwrap();
    let smaller = Camera::equirectangular(32, 16);
    let other = SphereImage::new(&pixels, 32, smaller).unwrap();
    let view = View::looking_at(&Vector3::x_axis(), 1.0, 8);
    let mut out = [0; 64];
    let not_begun = Err(RectifyError::NotBegun);
    assert_eq!(gpu.cut(&sphere, &[Cut::bilinear(view)], &mut [&mut out]), not_begun);
    gpu.begin_frame(&sphere).unwrap();
    assert_eq!(gpu.cut(&sphere, &[Cut::bilinear(view)], &mut [&mut out]), Ok(()));
    assert_eq!(gpu.cut(&other, &[Cut::bilinear(view)], &mut [&mut out]), not_begun);
    assert_eq!(gpu.cut(&sphere, &[], &mut []), Ok(()));
}
