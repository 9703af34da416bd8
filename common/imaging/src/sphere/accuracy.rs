//! The fast paths against exact ones in double precision.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::f64::consts::TAU;

use flockeye_geometry::camera::Equirectangular;
use flockeye_geometry::view::{View, ViewPixel};
use nalgebra::{Quaternion, Unit, UnitQuaternion, Vector3};
use proptest::prelude::*;

use super::cut::{Band, cut_band_plain};
use super::mapping::{LANES, Mapping, ONE};
use super::patch::{Patch, Tile};
use super::*;

const CAMERA: Equirectangular = Equirectangular { width: 3840, height: 1920 };

/// Numbers that look random: splitmix64 (Steele, Lea, Flood: *Fast splittable pseudorandom number
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

    /// Any rotation, fields of 4 to 110 degrees, magnified 0.5 to 4 times.
    fn view(&mut self) -> View {
        let field = self.between(4f64.to_radians(), 110f64.to_radians());
        let focal_px = self.between(0.5, 4.0) * CAMERA.pixels_per_radian();
        let size_px = (2.0 * focal_px * (field / 2.0).tan()).ceil() as u32;
        View { camera_from_view: self.rotation(), focal_px, size_px }
    }
}

/// Noise of full contrast, blurred by a Gaussian of 0.8 px.
fn panorama() -> Vec<u8> {
    let (width, height) = (CAMERA.width as usize, CAMERA.height as usize);
    let kernel: Vec<f64> = (-3..=3).map(|k| (-f64::from(k * k) / (2.0 * 0.64)).exp()).collect();
    let sum: f64 = kernel.iter().sum();
    let mut numbers = Numbers(1);
    let noise: Vec<f64> =
        (0..width * height).map(|_| f64::from((numbers.next() >> 56) as u8)).collect();
    let blurred = |from: &[f64], at: &dyn Fn(usize, usize, isize) -> usize| -> Vec<f64> {
        (0..width * height)
            .map(|k| {
                let (x, y) = (k % width, k / width);
                let taps = kernel.iter().zip(-3isize..);
                taps.map(|(weight, step)| weight * from[at(x, y, step)]).sum::<f64>() / sum
            })
            .collect()
    };
    let across = blurred(&noise, &|x, y, step| {
        y * width + (x as isize + step).rem_euclid(width as isize) as usize
    });
    let both =
        blurred(&across, &|x, y, step| y.saturating_add_signed(step).min(height - 1) * width + x);
    both.into_iter().map(|grey| grey.round() as u8).collect()
}

/// Bilinear interpolation where `view` sees the sphere at pixel (x, y), in double precision.
fn exact(sphere: &SphereImage<'_>, view: &View, x: u32, y: u32) -> f64 {
    let camera = sphere.camera();
    let ray = view.ray(ViewPixel::new(f64::from(x), f64::from(y)));
    let at = camera.project(&ray).0;
    let (left, top) = (at.x.floor(), at.y.floor());
    let (width, height) = (camera.width as i32, camera.height as i32);
    let pixel = |dx: i32, dy: i32| {
        let (mut column, mut row) = (left as i32 + dx, top as i32 + dy);
        if row < 0 || row >= height {
            column += width / 2;
            row = if row < 0 { -1 - row } else { 2 * height - 1 - row };
        }
        let column = column.rem_euclid(width) as usize;
        f64::from(sphere.pixels()[row as usize * sphere.stride() + column])
    };
    let (right, down) = (at.x - left, at.y - top);
    (1.0 - down) * ((1.0 - right) * pixel(0, 0) + right * pixel(1, 0))
        + down * ((1.0 - right) * pixel(0, 1) + right * pixel(1, 1))
}

/// Views where something can go wrong: the poles, the seam, both, and the corners of wide views.
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

#[test]
fn interpolated_positions_are_within_the_stated_error() {
    let mut numbers = Numbers(2);
    let (mut tiles, mut worst) = (0, 0f64);
    for _ in 0..3000 {
        let view = numbers.view();
        let mapping = Mapping::new(CAMERA, &view);
        for _ in 0..20 {
            let side =
                |numbers: &mut Numbers| (8 + 8 * (numbers.next() % 4) as u32).min(view.size_px);
            let (width, height) = (side(&mut numbers) & !7, side(&mut numbers));
            let mut place = |side| (numbers.next() % u64::from(view.size_px - side + 1)) as u32;
            let tile = Tile { x: place(width), y: place(height), width, height };
            let Some(patch) = Patch::fit(&mapping, tile) else { continue };
            tiles += 1;
            for first in (0..width).step_by(LANES) {
                let [mut columns, mut rows] = patch.strip(first).series;
                for y in 0..height {
                    // The outermost columns and one inside are enough: tiles lie everywhere.
                    for k in [0, 3, 7] {
                        let at = ViewPixel::new(
                            f64::from(tile.x + first) + k as f64,
                            f64::from(tile.y + y),
                        );
                        let exact = CAMERA.project(&view.ray(at)).0;
                        let turn = f64::from(CAMERA.width);
                        let column = f64::from(columns.value[k]) / ONE - exact.x;
                        let column = column - (column / turn).round() * turn;
                        let row = f64::from(rows.value[k]) / ONE - exact.y;
                        worst = worst.max(column.abs()).max(row.abs());
                    }
                    columns.advance();
                    rows.advance();
                }
            }
        }
    }
    assert!(tiles > 30_000, "only {tiles} tiles were interpolated");
    assert!(worst <= MAX_MAPPING_ERROR_PX, "{worst} px");
}

#[test]
fn exact_positions_are_exact() {
    let mut numbers = Numbers(3);
    let mut views = hard_views();
    views.extend((0..200).map(|_| numbers.view()));
    for view in views {
        let mapping = Mapping::new(CAMERA, &view);
        for _ in 0..200 {
            let mut place = || (numbers.next() % u64::from(view.size_px)) as u32;
            let (x, y) = (place(), place());
            let (columns, rows) = mapping.positions(x, y);
            for k in 0..LANES {
                let at = ViewPixel::new(f64::from(x) + k as f64, f64::from(y));
                let exact = CAMERA.project(&view.ray(at)).0;
                let turn = f64::from(CAMERA.width);
                let column = f64::from(columns[k]) / ONE - exact.x;
                let column = column - (column / turn).round() * turn;
                let row = f64::from(rows[k]) / ONE - exact.y;
                assert!(column.abs() < 1e-4 && row.abs() < 1e-4, "{view:?} {at:?} {column} {row}");
            }
        }
    }
}

#[test]
fn views_differ_from_exact_ones_by_two_greys_at_most() {
    let pixels = panorama();
    let sphere = SphereImage::new(&pixels, 3840, CAMERA).unwrap();
    let mut numbers = Numbers(4);
    let mut views = hard_views();
    views.extend((0..60).map(|_| numbers.view()));
    let (mut sum, mut count, mut worst) = (0.0, 0u32, 0f64);
    for view in views {
        let size = view.size_px;
        let mut out = vec![0; (size * size) as usize];
        rectify_into(&sphere, &view, &mut out, size as usize).unwrap();
        let mut of_view = (0.0, 0u32);
        // Steps prime to the tiles and strips, so that every place in them comes up.
        let step = if size > 1000 { 13 } else { 3 };
        for y in (0..size).step_by(step) {
            for x in (0..size).step_by(step) {
                let difference =
                    (f64::from(out[(y * size + x) as usize]) - exact(&sphere, &view, x, y)).abs();
                assert!(difference <= 2.0, "{view:?} ({x}, {y}): {difference}");
                of_view = (of_view.0 + difference, of_view.1 + 1);
                worst = worst.max(difference);
            }
        }
        assert!(of_view.0 / f64::from(of_view.1) <= 0.5, "{view:?}: {of_view:?}");
        (sum, count) = (sum + of_view.0, count + of_view.1);
    }
}

#[test]
fn vector_code_gives_the_bytes_of_plain_code() {
    let pixels = panorama();
    let sphere = SphereImage::new(&pixels, 3840, CAMERA).unwrap();
    let mut numbers = Numbers(5);
    let mut views = hard_views();
    views.extend((0..20).map(|_| View { size_px: 301, ..numbers.view() }));
    for view in views {
        let size = view.size_px as usize;
        let (mut fast, mut plain) = (vec![0; size * size], vec![1; size * size]);
        rectify_into(&sphere, &view, &mut fast, size).unwrap();
        let band = Band { view: &view, y: 0, rows: view.size_px, out: &mut plain, stride: size };
        cut_band_plain(&sphere, band);
        assert!(fast == plain, "{view:?}");
    }
}

#[test]
fn threads_give_the_bytes_of_one() {
    let pixels = panorama();
    let sphere = SphereImage::new(&pixels, 3840, CAMERA).unwrap();
    let mut views = hard_views();
    views.truncate(12);
    let cut = |threads| {
        let mut outputs: Vec<_> =
            views.iter().map(|view| vec![0; view.size_px.pow(2) as usize]).collect();
        let mut slices: Vec<&mut [u8]> = outputs.iter_mut().map(Vec::as_mut_slice).collect();
        rectify_all(&sphere, &views, &mut slices, threads).unwrap();
        outputs
    };
    let alone = cut(1);
    assert!(cut(2) == alone && cut(5) == alone);
}

#[test]
fn only_the_view_is_written_whatever_its_size() {
    let pixels: Vec<u8> = (0..640 * 320).map(|k| (k % 640 / 4) as u8).collect();
    let camera = Equirectangular { width: 640, height: 320 };
    let sphere = SphereImage::new(&pixels, 640, camera).unwrap();
    for size in 1..=70u32 {
        let view = View::looking_at(&Vector3::x_axis(), 0.4, size);
        let stride = size as usize + 5;
        let mut out = vec![255u8; stride * size as usize];
        rectify_into(&sphere, &view, &mut out, stride).unwrap();
        for (y, row) in out.chunks(stride).enumerate() {
            assert!(row[size as usize..].iter().all(|&grey| grey == 255), "{size}: row {y}");
            for (x, &grey) in row[..size as usize].iter().enumerate() {
                let exact = exact(&sphere, &view, x as u32, y as u32);
                assert!((f64::from(grey) - exact).abs() < 1.0, "{size}: ({x}, {y}) {grey} {exact}");
            }
        }
    }
}

#[test]
fn strides_too_long_for_vector_code_are_cut_all_the_same() {
    let stride = 40_000;
    let camera = Equirectangular { width: 128, height: 64 };
    let pixels: Vec<u8> = (0..stride * 64).map(|k| (k % stride) as u8).collect();
    let sphere = SphereImage::new(&pixels, stride, camera).unwrap();
    let view = View::looking_at(&Vector3::x_axis(), 0.5, 64);
    let mut out = vec![0; 64 * 64];
    rectify_into(&sphere, &view, &mut out, 64).unwrap();
    assert!((f64::from(out[32 * 64 + 10]) - exact(&sphere, &view, 10, 32)).abs() < 1.0);
}

proptest! {
    /// However odd the sphere and the view: no panic, and the greys lie between the sphere's.
    #[test]
    fn any_view_of_any_sphere_can_be_cut(
        half_width in 1..40u32,
        height in 2..60u32,
        padding in 0..9usize,
        focal in -2.0..5.0f64,
        size_px in 1..90u32,
        seed: u64,
    ) {
        let camera = Equirectangular { width: 2 * half_width, height };
        let stride = camera.width as usize + padding;
        let mut numbers = Numbers(seed);
        let length = stride * (height as usize - 1) + camera.width as usize;
        let pixels: Vec<u8> = (0..length).map(|_| 50 + (numbers.next() % 100) as u8).collect();
        let sphere = SphereImage::new(&pixels, stride, camera).unwrap();
        let view = View {
            camera_from_view: numbers.rotation(),
            focal_px: 10f64.powf(focal) * TAU,
            size_px,
        };
        let mut out = vec![0; (size_px * size_px) as usize];
        rectify_into(&sphere, &view, &mut out, size_px as usize).unwrap();
        prop_assert!(out.iter().all(|grey| (50..150).contains(grey)));
    }
}
