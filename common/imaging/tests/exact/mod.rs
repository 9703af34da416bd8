//! Views in double precision, pixel by pixel, for comparison.

use flockeye_geometry::camera::{Camera, CameraModel, Lens, LensCurve, SpherePixel};
use flockeye_geometry::view::{View, ViewPixel};
use flockeye_imaging::sphere::{Cut, Interpolation, SphereImage};
use nalgebra::{Isometry3, Rotation3, Translation3, Unit, UnitQuaternion, Vector3};

/// Cameras of every model, with one centre and with two lenses.
pub(crate) fn cameras() -> [Camera; 6] {
    let lens = |ahead: f64, u: f64, curve, focal_px| {
        let axis = Vector3::x() * ahead;
        let right = axis.cross(&Vector3::z());
        let axes = Rotation3::from_basis_unchecked(&[right, axis.cross(&right), axis]);
        let tilt = UnitQuaternion::from_scaled_axis(Vector3::new(0.01, -0.02, 1.2));
        Lens {
            camera_from_lens: Isometry3::from_parts(
                Translation3::from(axis * 0.008),
                UnitQuaternion::from_rotation_matrix(&axes) * tilt,
            ),
            centre_px: [u, 958.0].into(),
            circle_px: 950.0,
            field_rad: 195f64.to_radians(),
            focal_px: [focal_px, 1.002 * focal_px].into(),
            curve,
        }
    };
    let pair = |curve, focal_px| {
        let lenses = [lens(1.0, 958.0, curve, focal_px), lens(-1.0, 2880.0, curve, focal_px)];
        Camera::new(3840, 1920, CameraModel::DualFisheye(lenses)).unwrap()
    };
    let polynomial = LensCurve::Equidistant([-0.02, 0.005, -0.003, 0.0004]);
    let spheres = LensCurve::DoubleSphere { xi: 0.0024, alpha: 0.6605 };
    let unified = LensCurve::Unified { xi: 1.84, distortion: [0.016, -0.31, 0.001, 0.002] };
    let stitched = CameraModel::Equirectangular { lens_distance_m: 0.016 };
    let plane = CameraModel::Stereographic { field_rad: 300f64.to_radians() };
    [
        Camera::equirectangular(3840, 1920),
        Camera::new(3840, 1920, stitched).unwrap(),
        pair(polynomial, 560.0),
        pair(spheres, 550.0),
        pair(unified, 1700.0),
        Camera::new(2000, 1920, plane).unwrap(),
    ]
}

/// Views of difficult places: the poles, the seam, both, the border between two lenses, directions
/// that no lens sees, the corners of wide views. One is easy.
pub(crate) fn hard_views() -> Vec<View> {
    let directions = [
        (0.0, 0.0, 1.0),
        (0.01, 0.003, 1.0),
        (0.3, -0.2, -1.0),
        (-1.0, 0.0, 0.0),
        (-1.0, 0.001, 0.7),
        (0.02, 1.0, 0.1),
        (-0.1, -1.0, 0.3),
        (1.0, 0.3, 0.2),
    ];
    let mut views = Vec::new();
    for (k, (x, y, z)) in directions.into_iter().enumerate() {
        let direction = Unit::new_normalize(Vector3::new(x, y, z));
        for (field, size) in [(4.0, 163), (20.0, 400), (74.75, 467), (110.0, 414)] {
            let mut view = View::looking_at(&direction, f64::to_radians(field), size);
            let roll = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), k as f64 * 0.7);
            view.camera_from_view *= roll;
            views.push(view);
        }
    }
    views
}

/// Noise of full contrast, blurred by a Gaussian of 0.8 px. The first column is the last one's
/// neighbour.
pub(crate) fn panorama(camera: &Camera, stride: usize) -> Vec<u8> {
    let (width, height) = (camera.width() as usize, camera.height() as usize);
    let kernel: Vec<f32> = (-3..=3).map(|k| (-(k * k) as f32 / (2.0 * 0.64)).exp()).collect();
    let sum: f32 = kernel.iter().sum();
    // Knuth's linear congruential generator (MMIX).
    let mut state = 1u64;
    let noise: Vec<f32> = (0..width * height)
        .map(|_| {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            f32::from((state >> 56) as u8)
        })
        .collect();
    let across: Vec<f32> = (0..width * height)
        .map(|k| {
            let (x, row) = (k % width, &noise[k / width * width..][..width]);
            let taps = kernel.iter().enumerate();
            taps.map(|(tap, weight)| weight * row[(x + width + tap - 3) % width]).sum::<f32>() / sum
        })
        .collect();
    let mut pixels = vec![0; stride * height];
    for (y, line) in pixels.chunks_mut(stride).enumerate() {
        for (x, pixel) in line[..width].iter_mut().enumerate() {
            let taps = kernel.iter().enumerate().map(|(tap, weight)| {
                let row = (y + tap).saturating_sub(3).min(height - 1);
                weight * across[row * width + x]
            });
            *pixel = (taps.sum::<f32>() / sum).round() as u8;
        }
    }
    pixels
}

/// Where the cut's pixel (x, y) lies in the sphere image.
pub(crate) fn position(camera: &Camera, cut: &Cut, x: f64, y: f64) -> Option<SpherePixel> {
    camera.at_distance(cut.distance_m).project(&cut.view.ray(ViewPixel::new(x, y)))
}

/// The grey value of the cut's pixel (x, y), interpolated in the sphere image; black where that
/// does not show it.
pub(crate) fn grey(sphere: &SphereImage<'_>, cut: &Cut, x: f64, y: f64) -> f64 {
    let camera = sphere.camera();
    let Some(at) = position(camera, cut, x, y) else { return 0.0 };
    let (left, top) = (at.0.x.floor(), at.0.y.floor());
    let (width, height) = (camera.width() as i32, camera.height() as i32);
    let is_round = is_round(camera);
    let pixel = |dx: i32, dy: i32| {
        let (mut column, mut row) = (left as i32 + dx, top as i32 + dy);
        if is_round && (row < 0 || row >= height) {
            column += width / 2;
            row = if row < 0 { -1 - row } else { 2 * height - 1 - row };
        }
        let column =
            if is_round { column.rem_euclid(width) } else { column.clamp(0, width - 1) } as usize;
        let row = row.clamp(0, height - 1) as usize;
        f64::from(sphere.pixels()[row * sphere.stride() + column])
    };
    let weights = |t: f64| match cut.interpolation {
        Interpolation::Bilinear => [0.0, 1.0 - t, t, 0.0],
        // Keys' article, with a = -1/2.
        Interpolation::Cubic => [
            -0.5 * (t + 1.0).powi(3) + 2.5 * (t + 1.0).powi(2) - 4.0 * (t + 1.0) + 2.0,
            1.5 * t.powi(3) - 2.5 * t * t + 1.0,
            1.5 * (1.0 - t).powi(3) - 2.5 * (1.0 - t).powi(2) + 1.0,
            -0.5 * (2.0 - t).powi(3) + 2.5 * (2.0 - t).powi(2) - 4.0 * (2.0 - t) + 2.0,
        ],
    };
    let (across, along) = (weights(at.0.x - left), weights(at.0.y - top));
    let mut grey = 0.0;
    for (row, along) in (-1..3).zip(along) {
        for (column, across) in (-1..3).zip(across) {
            grey += along * across * pixel(column, row);
        }
    }
    grey.clamp(0.0, 255.0)
}

/// Whether rounding to single precision leaves the pixel where it is: neither on the border of an
/// image circle or between two lenses, nor on a pole itself.
pub(crate) fn is_settled(camera: &Camera, cut: &Cut, x: f64, y: f64) -> bool {
    // Pixels of the view, more than single precision is off: next to a pole it is off by less,
    // because directions are counted from there.
    let shift_px = if is_round(camera) { 1e-5 } else { 1e-3 };
    let here = position(camera, cut, x, y);
    [(shift_px, 0.0), (-shift_px, 0.0), (0.0, shift_px), (0.0, -shift_px)].into_iter().all(
        |(dx, dy)| match (here, position(camera, cut, x + dx, y + dy)) {
            (None, None) => true,
            (Some(here), Some(there)) => apart(camera, here, there) < 0.01,
            _ => false,
        },
    )
}

/// The larger of columns and rows between two points, pixels.
fn apart(camera: &Camera, one: SpherePixel, other: SpherePixel) -> f64 {
    let mut columns = (one.0.x - other.0.x).abs();
    if is_round(camera) {
        columns = columns.min(f64::from(camera.width()) - columns);
    }
    columns.max((one.0.y - other.0.y).abs())
}

fn is_round(camera: &Camera) -> bool {
    matches!(camera.model(), CameraModel::Equirectangular { .. })
}
