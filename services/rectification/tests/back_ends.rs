//! Both back ends against views in double precision, over all camera models.
#![allow(clippy::unwrap_used, clippy::expect_used)]

#[path = "../../../common/imaging/tests/exact/mod.rs"]
mod exact;

use flockeye_contract::FrameOrder;
use flockeye_geometry::camera::Camera;
use flockeye_geometry::view::View;
use flockeye_imaging::sphere::{Cut, MAX_MAPPING_ERROR_PX, SphereImage};
use flockeye_rectification::cpu::CpuRectifier;
use flockeye_rectification::gpu::{FoundAdapter, GpuRectifier};
use flockeye_rectification::rectifier::Rectifier;
use nalgebra::Vector3;

use self::exact::{cameras, grey, hard_views, is_settled, panorama};

/// The processor, and the graphics processor where there is one.
fn back_ends() -> Vec<Box<dyn Rectifier>> {
    let mut back_ends: Vec<Box<dyn Rectifier>> = vec![Box::new(CpuRectifier::new(2))];
    match FoundAdapter::best() {
        Ok(found) => back_ends.push(Box::new(GpuRectifier::open(found).unwrap())),
        Err(error) => {
            let what = format!("a Vulkan device, so only the processor is tested: {error}");
            flockeye_require::absent(flockeye_require::VULKAN, &what);
        }
    }
    back_ends
}

fn key(sequence: u64) -> FrameOrder {
    (0, 0, sequence)
}

fn cut(
    rectifier: &mut dyn Rectifier,
    frame: FrameOrder,
    sphere: &SphereImage<'_>,
    cut: &Cut,
) -> Vec<u8> {
    let mut out = vec![0; cut.view.size_px.pow(2) as usize];
    rectifier.cut(frame, sphere, cut, &mut out).unwrap();
    out
}

/// Cuts all, and hands pixels of each to `compare`, with their places. Steps are prime to words,
/// tiles and workgroups, so that every place in them comes up.
fn each_pixel(
    rectifier: &mut dyn Rectifier,
    frame: FrameOrder,
    sphere: &SphereImage<'_>,
    cuts: &[Cut],
    mut compare: impl FnMut(usize, f64, f64, f64),
) {
    rectifier.order(frame, sphere, cuts).unwrap();
    for (index, wanted) in cuts.iter().enumerate() {
        let out = cut(rectifier, frame, sphere, wanted);
        let size = wanted.view.size_px as usize;
        for y in (0..size).step_by(5) {
            for x in (0..size).step_by(7) {
                if is_settled(sphere.camera(), wanted, x as f64, y as f64) {
                    compare(index, x as f64, y as f64, f64::from(out[y * size + x]));
                }
            }
        }
    }
}

#[test]
fn views_of_every_camera_are_those_of_double_precision() {
    let mut back_ends = back_ends();
    for (number, camera) in cameras().into_iter().enumerate() {
        // No row but the first begins with a whole word.
        let stride = camera.width() as usize + 3;
        let pixels = panorama(&camera, stride);
        let sphere = SphereImage::new(&pixels, stride, camera).unwrap();
        let mut cuts = Vec::new();
        for (k, view) in hard_views().into_iter().enumerate() {
            let distance_m = [f64::INFINITY, 0.8][k % 2];
            cuts.push(Cut { distance_m, ..Cut::bilinear(view) });
            cuts.push(Cut { distance_m, ..Cut::cubic(view) });
        }
        for rectifier in &mut back_ends {
            let mut sums = vec![(0.0, 0.0); cuts.len()];
            let mut worst = 0f64;
            let name = rectifier.name();
            each_pixel(rectifier.as_mut(), key(number as u64), &sphere, &cuts, |k, x, y, found| {
                let difference = (found - grey(&sphere, &cuts[k], x, y)).abs();
                let cut = &cuts[k];
                assert!(
                    difference <= 2.0,
                    "{name}, camera {number}, {cut:?} ({x}, {y}): {difference}"
                );
                sums[k] = (sums[k].0 + difference, sums[k].1 + 1.0);
                worst = worst.max(difference);
            });
            let mean =
                sums.iter().map(|(sum, count)| sum / f64::max(*count, 1.0)).fold(0.0, f64::max);
            println!(
                "{name}, camera {number}: {mean:.3} greys on a view's average, {worst:.2} at most"
            );
            assert!(mean <= 0.5, "{name}, camera {number}: {mean}");
        }
    }
}

/// Stripes one pixel wide, black and white by turns: the grey value between two is the position
/// between them, to 1/255 px, however steep the mapping.
fn stripes(camera: &Camera, is_white: impl Fn(u32, u32) -> bool) -> Vec<u8> {
    let (width, height) = (camera.width(), camera.height());
    let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
    pixels.map(|(x, y)| 255 * u8::from(is_white(x, y))).collect()
}

#[test]
fn positions_are_within_the_stated_error() {
    // Weights of columns have eight binary digits, cut, and greys are whole.
    const RESOLUTION: f64 = 1.6;
    let mut back_ends = back_ends();
    let mut frame = 0;
    for (number, camera) in cameras().into_iter().enumerate() {
        for along_rows in [false, true] {
            let pixels = stripes(&camera, |x, y| if along_rows { y % 2 == 0 } else { x % 2 == 0 });
            let sphere = SphereImage::new(&pixels, camera.width() as usize, camera).unwrap();
            let cut = |view| Cut { distance_m: 0.9, ..Cut::bilinear(view) };
            let cuts: Vec<Cut> = hard_views().into_iter().map(cut).collect();
            frame += 1;
            for rectifier in &mut back_ends {
                let mut worst = 0f64;
                let name = rectifier.name();
                // The shader interpolates no positions: only single precision is between.
                let error_px = if name.starts_with("gpu") { 0.004 } else { MAX_MAPPING_ERROR_PX };
                let tolerance = 255.0 * error_px + RESOLUTION;
                each_pixel(rectifier.as_mut(), key(frame), &sphere, &cuts, |k, x, y, found| {
                    let difference = (found - grey(&sphere, &cuts[k], x, y)).abs();
                    let cut = &cuts[k];
                    assert!(
                        difference <= tolerance,
                        "{name}, camera {number}, {cut:?} ({x}, {y}): {difference} greys"
                    );
                    worst = worst.max(difference);
                });
                let rows = if along_rows { "rows" } else { "columns" };
                println!("{name}, camera {number}: {rows} within {:.4} px", worst / 255.0);
            }
        }
    }
}

#[test]
fn back_ends_differ_by_two_greys_at_most_whatever_was_ordered() {
    let mut back_ends = back_ends();
    let camera = Camera::equirectangular(958, 480);
    let pixels = panorama(&camera, 960);
    let sphere = SphereImage::new(&pixels, 960, camera).unwrap();
    let cuts: Vec<Cut> = hard_views().into_iter().map(Cut::bilinear).collect();
    let mut all = Vec::new();
    for rectifier in &mut back_ends {
        // All at once, some and then others, and none beforehand.
        rectifier.order(key(0), &sphere, &cuts).unwrap();
        rectifier.order(key(1), &sphere, &cuts[5..9]).unwrap();
        rectifier.order(key(1), &sphere, &cuts[7..20]).unwrap();
        let views = |rectifier: &mut dyn Rectifier, frame| -> Vec<Vec<u8>> {
            cuts.iter().map(|wanted| cut(rectifier, frame, &sphere, wanted)).collect()
        };
        let first = views(rectifier.as_mut(), key(0));
        assert!(first == views(rectifier.as_mut(), key(1)));
        assert!(first == views(rectifier.as_mut(), key(2)));
        all.push(first);
    }
    let Some(theirs) = all.get(1) else { return };
    for (cut, (one, other)) in cuts.iter().zip(all[0].iter().zip(theirs)) {
        let size = cut.view.size_px as usize;
        for (k, (a, b)) in one.iter().zip(other).enumerate() {
            let (x, y) = ((k % size) as f64, (k / size) as f64);
            let is_like = a.abs_diff(*b) <= 2;
            assert!(is_like || !is_settled(&camera, cut, x, y), "{cut:?} ({x}, {y}): {a} {b}");
        }
    }
}

#[test]
fn views_of_a_frame_stay_its_own_when_the_next_ones_are_prepared() {
    let camera = Camera::equirectangular(256, 128);
    let frames: Vec<Vec<u8>> = (0..6u8).map(|k| vec![40 * k; 256 * 128]).collect();
    let sphere = |frame: usize| SphereImage::new(&frames[frame], 256, camera).unwrap();
    let looks = |x: f64| View::looking_at(&Vector3::x_axis(), x, 65);
    let cuts = [0.3, 0.5, 0.7].map(|field| Cut::bilinear(looks(field)));
    for mut rectifier in back_ends() {
        let rectifier = rectifier.as_mut();
        let expect = |rectifier: &mut dyn Rectifier, frame: usize, index: usize| {
            let out = cut(rectifier, key(frame as u64), &sphere(frame), &cuts[index]);
            let name = rectifier.name();
            assert!(out.iter().all(|&grey| grey == 40 * frame as u8), "{name}: frame {frame}");
        };
        rectifier.order(key(0), &sphere(0), &cuts[..2]).unwrap();
        rectifier.prepare(key(1), &sphere(1)).unwrap();
        expect(rectifier, 0, 0);
        // A newer one takes its place, and what was ordered before still comes, and what was not.
        rectifier.prepare(key(2), &sphere(2)).unwrap();
        expect(rectifier, 0, 1);
        expect(rectifier, 0, 2);
        rectifier.order(key(2), &sphere(2), &cuts).unwrap();
        rectifier.prepare(key(3), &sphere(3)).unwrap();
        expect(rectifier, 2, 0);
        expect(rectifier, 0, 0);
        expect(rectifier, 3, 1);
        // Even of a frame that was never told of, and of one that has left the device.
        expect(rectifier, 5, 0);
        expect(rectifier, 0, 2);
        expect(rectifier, 2, 2);
    }
}
