//! Compares the fast paths with exact ones in double precision.
#![allow(clippy::unwrap_used, clippy::expect_used)]

#[path = "../../tests/exact/mod.rs"]
#[allow(dead_code, reason = "shared with tests that need more of it")]
mod exact;

use std::f64::consts::TAU;

use flockeye_geometry::camera::{Camera, CameraModel};
use flockeye_geometry::view::{View, ViewPixel};
use nalgebra::{Quaternion, Unit, UnitQuaternion, Vector3};
use proptest::prelude::*;

use self::exact::{cameras, grey, panorama};
use super::any_camera::CameraMapping;
use super::cut::{Kernel, RowBand, cut_band_by};
use super::equirectangular::EquirectangularMapping;
use super::fixed_point::{LANES, NOWHERE, ONE};
use super::mapping::{Mapping, TileFit};
use super::patch::ViewTile;
use super::*;

const CAMERA: Camera = Camera::equirectangular(3840, 1920);

/// Calls `ask` with the mapping for this camera.
fn with_mapping<T>(camera: &Camera, view: &View, ask: impl FnOnce(&dyn Mapping) -> T) -> T {
    match camera.as_equirectangular() {
        Some(camera) => ask(&EquirectangularMapping::new(camera, view)),
        None => ask(&CameraMapping::new(camera, view)),
    }
}

/// Pseudorandom numbers: splitmix64 (Steele, Lea, Flood: *Fast splittable pseudorandom number
/// generators*, OOPSLA 2014).
struct Numbers(u64);

impl Numbers {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut mixed = self.0;
        mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        mixed ^ (mixed >> 31)
    }

    fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * (self.next() >> 11) as f64 / (1u64 << 53) as f64
    }

    fn rotation(&mut self) -> UnitQuaternion<f64> {
        loop {
            let [x, y, z, w] = [(); 4].map(|()| self.between(-1.0, 1.0));
            let norm = (x * x + y * y + z * z + w * w).sqrt();
            if (0.1..1.0).contains(&norm) {
                return Unit::new_normalize(Quaternion::new(w, x, y, z));
            }
        }
    }

    /// Any rotation, fields of view of 4 to 110 degrees, magnified 0.5 to 4 times.
    fn view(&mut self) -> View {
        let field = self.between(4f64.to_radians(), 110f64.to_radians());
        let focal_px = self.between(0.5, 4.0) * CAMERA.pixels_per_radian();
        let size_px = (2.0 * focal_px * (field / 2.0).tan()).ceil() as u32;
        View { camera_from_view: self.rotation(), focal_px, size_px }
    }
}

/// Views of difficult places: the poles, the seam, both, and the corners of wide views.
fn hard_views() -> Vec<View> {
    let directions = [
        Vector3::new(0.0, 0.0, 1.0),
        Vector3::new(0.0, 0.0, -1.0),
        Vector3::new(0.01, 0.003, 1.0),
        Vector3::new(0.3, -0.2, -1.0),
        Vector3::new(-1.0, 0.0, 0.0),
        Vector3::new(-1.0, 0.001, 0.7),
        Vector3::new(-0.2, 0.0, -1.0),
        Vector3::new(1.0, 0.0, 0.0),
    ];
    let mut views = Vec::new();
    for direction in directions {
        for (field, size) in [(4.0, 160), (20.0, 400), (74.75, 936), (110.0, 873)] {
            let field = f64::to_radians(field);
            views.push(View::looking_at(&Unit::new_normalize(direction), field, size));
        }
    }
    views
}

/// Distance of two points, the larger of columns and rows; an equirectangular image wraps.
fn apart(camera: &Camera, columns: f64, rows: f64) -> f64 {
    let turn = f64::from(camera.width());
    let columns = match camera.model() {
        CameraModel::Equirectangular { .. } => columns - (columns / turn).round() * turn,
        _ => columns,
    };
    columns.abs().max(rows.abs())
}

#[test]
fn interpolated_positions_are_within_the_stated_error() {
    let mut numbers = Numbers(2);
    for (index, camera) in cameras().into_iter().enumerate() {
        let camera = camera.at_distance(0.9);
        let (mut tiles, mut worst) = (0, 0f64);
        for _ in 0..3000 {
            let view = numbers.view();
            for _ in 0..10 {
                let side =
                    |numbers: &mut Numbers| (8 + 8 * (numbers.next() % 4) as u32).min(view.size_px);
                let (width, height) = (side(&mut numbers) & !7, side(&mut numbers));
                let mut place = |side| (numbers.next() % u64::from(view.size_px - side + 1)) as u32;
                let tile = ViewTile { x: place(width), y: place(height), width, height };
                let fit = with_mapping(&camera, &view, |mapping| mapping.fit(tile));
                let TileFit::Interpolated(patch) = fit else { continue };
                tiles += 1;
                for first in (0..width).step_by(LANES) {
                    let [mut columns, mut rows] = patch.strip(first);
                    for y in 0..height {
                        // The outermost columns and one inside do: tiles lie everywhere.
                        for k in [0, 3, 7] {
                            let at = ViewPixel::new(
                                f64::from(tile.x + first) + k as f64,
                                f64::from(tile.y + y),
                            );
                            let exact = camera.project(&view.ray(at)).expect("inside of a circle");
                            let error = apart(
                                &camera,
                                f64::from(columns.value[k]) / ONE - exact.0.x,
                                f64::from(rows.value[k]) / ONE - exact.0.y,
                            );
                            worst = worst.max(error);
                        }
                        columns.advance();
                        rows.advance();
                    }
                }
            }
        }
        println!("camera {index}: {tiles} tiles interpolated, {worst:.4} px at most");
        assert!(tiles > 12_000, "camera {index}: only {tiles} tiles were interpolated");
        assert!(worst <= MAX_MAPPING_ERROR_PX, "camera {index}: {worst} px");
    }
}

#[test]
fn exact_positions_are_exact() {
    let mut numbers = Numbers(3);
    for camera in cameras() {
        let camera = camera.at_distance(1.5);
        let mut views = hard_views();
        views.extend((0..100).map(|_| numbers.view()));
        for view in views {
            for _ in 0..100 {
                let mut place = || (numbers.next() % u64::from(view.size_px)) as u32;
                let (x, y) = (place(), place());
                let (columns, rows) =
                    with_mapping(&camera, &view, |mapping| mapping.positions(x, y));
                for k in 0..LANES {
                    let at = ViewPixel::new(f64::from(x) + k as f64, f64::from(y));
                    let Some(exact) = camera.project(&view.ray(at)) else {
                        assert_eq!(columns[k], NOWHERE);
                        continue;
                    };
                    let column = f64::from(columns[k]) / ONE - exact.0.x;
                    let row = f64::from(rows[k]) / ONE - exact.0.y;
                    let error = apart(&camera, column, row);
                    assert!(error < 1e-4, "{view:?} {at:?} {column} {row}");
                }
            }
        }
    }
}

#[test]
fn views_differ_from_exact_ones_by_two_greys_at_most() {
    let mut numbers = Numbers(4);
    for (index, camera) in cameras().into_iter().enumerate() {
        let pixels = panorama(&camera, camera.width() as usize);
        let sphere = SphereImage::new(&pixels, camera.width() as usize, camera).unwrap();
        let mut views = hard_views();
        views.extend((0..30).map(|_| numbers.view()));
        let (mut sum, mut count, mut worst) = (0.0, 0u32, 0f64);
        for (k, view) in views.into_iter().enumerate() {
            let size = view.size_px;
            let distance_m = [f64::INFINITY, 0.8][k % 2];
            for cut in [Cut::bilinear(view), Cut::cubic(view)] {
                let cut = Cut { distance_m, ..cut };
                let mut out = vec![0; (size * size) as usize];
                rectify_into(&sphere, &cut, &mut out, size as usize).unwrap();
                let mut of_view = (0.0, 0u32);
                // Prime to the sizes of tiles and strips: every position is tested.
                let step = if size > 1000 { 13 } else { 5 };
                for y in (0..size).step_by(step) {
                    for x in (0..size).step_by(step) {
                        let exact = grey(&sphere, &cut, f64::from(x), f64::from(y));
                        let found = f64::from(out[(y * size + x) as usize]);
                        let difference = (found - exact).abs();
                        assert!(difference <= 2.0, "{camera:?} {cut:?} ({x}, {y}): {difference}");
                        of_view = (of_view.0 + difference, of_view.1 + 1);
                        worst = worst.max(difference);
                    }
                }
                assert!(of_view.0 / f64::from(of_view.1) <= 0.5, "{cut:?}: {of_view:?}");
                (sum, count) = (sum + of_view.0, count + of_view.1);
            }
        }
        println!(
            "camera {index}: {:.3} greys on average, {worst:.2} at most",
            sum / f64::from(count)
        );
    }
}

#[test]
fn vector_code_gives_the_bytes_of_plain_code() {
    let mut numbers = Numbers(5);
    for camera in cameras() {
        let pixels = panorama(&camera, camera.width() as usize);
        let sphere = SphereImage::new(&pixels, camera.width() as usize, camera).unwrap();
        let mut views = hard_views();
        views.extend((0..10).map(|_| View { size_px: 301, ..numbers.view() }));
        for view in views {
            for cut in [Cut::bilinear(view), Cut::cubic(view)] {
                let size = view.size_px as usize;
                let rows = view.size_px;
                let by = |kernel| {
                    let mut out = vec![1; size * size];
                    let band = RowBand { cut: &cut, y: 0, rows, out: &mut out, stride: size };
                    cut_band_by(kernel, &sphere, band);
                    out
                };
                let plain = by(Kernel::Plain);
                #[cfg(target_arch = "x86_64")]
                for kernel in [Kernel::Avx2, Kernel::Avx2Gather] {
                    assert!(
                        !kernel.works_on(&sphere) || by(kernel) == plain,
                        "{kernel:?}, {cut:?}"
                    );
                }
                let mut quickest = vec![0; size * size];
                rectify_into(&sphere, &cut, &mut quickest, size).unwrap();
                assert!(quickest == plain, "{cut:?}");
            }
        }
    }
}

#[test]
fn directions_that_no_lens_sees_are_black() {
    let plane = CameraModel::Stereographic { field_rad: 200f64.to_radians() };
    let camera = Camera::new(800, 800, plane).unwrap();
    let pixels = vec![200; 800 * 800];
    let sphere = SphereImage::new(&pixels, 800, camera).unwrap();
    let cut = |view: View| {
        let mut out = vec![7; view.size_px.pow(2) as usize];
        rectify_into(&sphere, &Cut::bilinear(view), &mut out, view.size_px as usize).unwrap();
        out
    };
    let behind = View::looking_at(&-Vector3::x_axis(), 1.0, 300);
    assert!(cut(behind).iter().all(|&grey| grey == 0));
    let border = View::looking_at(&Unit::new_normalize(Vector3::new(-0.17, 1.0, 0.0)), 1.0, 301);
    let out = cut(border);
    for (k, &grey) in out.iter().enumerate() {
        let at = ViewPixel::new((k % 301) as f64, (k / 301) as f64);
        let seen = camera.project(&border.ray(at)).is_some();
        assert_eq!(grey, if seen { 200 } else { 0 }, "{at:?}");
    }
    assert!(out.contains(&0) && out.contains(&200));
}

#[test]
fn several_threads_give_the_bytes_of_one() {
    let pixels = panorama(&CAMERA, 3840);
    let sphere = SphereImage::new(&pixels, 3840, CAMERA).unwrap();
    let cuts: Vec<_> = hard_views().into_iter().take(12).map(Cut::bilinear).collect();
    let cut = |threads| {
        let mut outputs: Vec<_> =
            cuts.iter().map(|cut| vec![0; cut.view.size_px.pow(2) as usize]).collect();
        let mut slices: Vec<&mut [u8]> = outputs.iter_mut().map(Vec::as_mut_slice).collect();
        rectify_all(&sphere, &cuts, &mut slices, threads).unwrap();
        outputs
    };
    let alone = cut(1);
    assert!(cut(2) == alone && cut(5) == alone);
}

#[test]
fn only_the_view_is_written_whatever_its_size() {
    let pixels: Vec<u8> = (0..640 * 320).map(|k| (k % 640 / 4) as u8).collect();
    let camera = Camera::equirectangular(640, 320);
    let sphere = SphereImage::new(&pixels, 640, camera).unwrap();
    for size in 1..=70u32 {
        let cut = Cut::bilinear(View::looking_at(&Vector3::x_axis(), 0.4, size));
        let stride = size as usize + 5;
        let mut out = vec![255u8; stride * size as usize];
        rectify_into(&sphere, &cut, &mut out, stride).unwrap();
        for (y, row) in out.chunks(stride).enumerate() {
            assert!(row[size as usize..].iter().all(|&grey| grey == 255), "{size}: row {y}");
            for (x, &grey) in row[..size as usize].iter().enumerate() {
                let exact = exact::grey(&sphere, &cut, x as f64, y as f64);
                assert!((f64::from(grey) - exact).abs() < 1.0, "{size}: ({x}, {y}) {grey} {exact}");
            }
        }
    }
}

#[test]
fn images_with_strides_too_long_for_vector_code_are_cut() {
    let stride = 40_000;
    let camera = Camera::equirectangular(128, 64);
    let pixels: Vec<u8> = (0..stride * 64).map(|k| (k % stride) as u8).collect();
    let sphere = SphereImage::new(&pixels, stride, camera).unwrap();
    let cut = Cut::bilinear(View::looking_at(&Vector3::x_axis(), 0.5, 64));
    let mut out = vec![0; 64 * 64];
    rectify_into(&sphere, &cut, &mut out, 64).unwrap();
    assert!((f64::from(out[32 * 64 + 10]) - grey(&sphere, &cut, 10.0, 32.0)).abs() < 1.0);
}

proptest! {
    /// For any sphere image and view nothing panics, and greys lie between those of the image.
    #[test]
    fn any_view_of_any_sphere_can_be_cut(
        half_width in 1..40u32,
        height in 2..60u32,
        padding in 0..9usize,
        focal in -2.0..5.0f64,
        size_px in 1..90u32,
        seed: u64,
    ) {
        let camera = Camera::equirectangular(2 * half_width, height);
        let stride = camera.width() as usize + padding;
        let mut numbers = Numbers(seed);
        let length = stride * (height as usize - 1) + camera.width() as usize;
        let pixels: Vec<u8> = (0..length).map(|_| 50 + (numbers.next() % 100) as u8).collect();
        let sphere = SphereImage::new(&pixels, stride, camera).unwrap();
        let view = View {
            camera_from_view: numbers.rotation(),
            focal_px: 10f64.powf(focal) * TAU,
            size_px,
        };
        let mut out = vec![0; (size_px * size_px) as usize];
        rectify_into(&sphere, &Cut::bilinear(view), &mut out, size_px as usize).unwrap();
        prop_assert!(out.iter().all(|grey| (50..150).contains(grey)));
        // A cubic overshoots.
        rectify_into(&sphere, &Cut::cubic(view), &mut out, size_px as usize).unwrap();
        prop_assert!(out.iter().all(|grey| (20..180).contains(grey)));
    }
}
