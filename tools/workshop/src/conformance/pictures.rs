//! Test pictures with known content: views that show a marker, and a sphere with its own brightness
//! along each ray.

use anyhow::ensure;
use flockeye_config::Resolved;
use flockeye_contract::{FrameHeader, Projection, Transfer};
use flockeye_dictionary::Dictionary;
use flockeye_geometry::camera::CameraModel;
use nalgebra::{Isometry3, Point2, Point3, Translation3, UnitQuaternion, Vector3};

use crate::dice::Dice;

/// Rays for each pixel, along each axis.
const SAMPLES: usize = 3;
const WHITE: f64 = 205.0;
const BLACK: f64 = 35.0;
const BACKGROUND: f64 = 120.0;

/// A marker in front of a view.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ShownMarker {
    pub id: u32,
    /// Pose of the printed pattern (origin in its middle, x right, y down, z into the paper) in the
    /// view's frame.
    pub view_from_print: Isometry3<f64>,
    /// Side of the black square, metres.
    pub side_m: f64,
}

impl ShownMarker {
    /// Marker `id` with sides of about `side_px` pixels in a view of this focal length, turned and
    /// tilted differently for each `number`.
    pub(crate) fn number(number: u32, id: u32, side_px: f64, focal_px: f64) -> Self {
        let number = f64::from(number);
        // Irrational steps make all views different.
        let swing = |step: f64, reach: f64| reach * (std::f64::consts::TAU * number * step).sin();
        let distance_m = 1.0 + swing(0.618_034, 0.2);
        let side_m = side_px * distance_m / focal_px;
        let turn = UnitQuaternion::from_euler_angles(
            swing(0.414_214, 0.6),
            swing(0.732_051, 0.6),
            std::f64::consts::TAU * number * 0.236_068,
        );
        let aside = Translation3::new(swing(0.302_776, 0.12), swing(0.541_381, 0.12), distance_m);
        Self { id, view_from_print: Isometry3::from_parts(aside, turn), side_m }
    }

    /// Positions of the corners in a view of this size, clockwise from the printed top left,
    /// pixels.
    pub(crate) fn corners(&self, size_px: u32, focal_px: f64) -> [Point2<f64>; 4] {
        let middle = f64::from(size_px - 1) / 2.0;
        [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]].map(|[x, y]| {
            let at = self.view_from_print * Point3::new(x * self.side_m, y * self.side_m, 0.0);
            Point2::new(middle + focal_px * at.x / at.z, middle + focal_px * at.y / at.z)
        })
    }
}

/// Pixels of a view, row by row: a grey wall, and the marker on a white sheet with a margin of one
/// cell.
pub(crate) fn view(
    dictionary: &Dictionary,
    shown: Option<&ShownMarker>,
    size_px: u32,
    focal_px: f64,
) -> Vec<u8> {
    let Some((shown, print)) = shown.and_then(|shown| Some((shown, dictionary.print(shown.id)?)))
    else {
        return vec![BACKGROUND as u8; (size_px * size_px) as usize];
    };
    let print_from_view = shown.view_from_print.inverse();
    let eye = print_from_view * Point3::origin();
    let middle = f64::from(size_px - 1) / 2.0;
    let cells = print.cells() as f64;
    let light = |u: f64, v: f64| {
        let ray = Vector3::new((u - middle) / focal_px, (v - middle) / focal_px, 1.0);
        let ray = print_from_view * ray;
        let reach = -eye.z / ray.z;
        let at = eye + ray * reach;
        // Position in cells from the top left of the black square.
        let [x, y] = [at.x, at.y].map(|along| (along / shown.side_m + 0.5) * cells);
        let is_on_sheet = [x, y].iter().all(|along| (-1.0..=cells + 1.0).contains(along));
        match is_on_sheet && reach > 0.0 {
            false => BACKGROUND,
            true if print.is_white(y.floor() as isize, x.floor() as isize) => WHITE,
            true => BLACK,
        }
    };
    let pixel = |index: u32| {
        let (u, v) = (f64::from(index % size_px), f64::from(index / size_px));
        let offset = |k: usize| (k as f64 + 0.5) / SAMPLES as f64 - 0.5;
        let sum: f64 = (0..SAMPLES * SAMPLES)
            .map(|k| light(u + offset(k % SAMPLES), v + offset(k / SAMPLES)))
            .sum();
        (sum / (SAMPLES * SAMPLES) as f64).round() as u8
    };
    (0..size_px * size_px).map(pixel).collect()
}

/// A frame of the configured camera, without its stamp.
///
/// # Errors
/// The test cannot draw pictures of the camera's projection.
pub(crate) fn frame_shape(resolved: &Resolved, transfer: Transfer) -> anyhow::Result<FrameHeader> {
    ensure!(
        matches!(resolved.camera.model(), CameraModel::Equirectangular { .. }),
        "this stage is tested with equirectangular frames. Cure: leave camera.projection as it is"
    );
    let camera = &resolved.pipeline.camera;
    Ok(FrameHeader {
        width: camera.width,
        height: camera.height,
        stride: camera.width,
        transfer: transfer.code(),
        projection: Projection::Equirectangular.code(),
        ..FrameHeader::default()
    })
}

/// Side of the cubic table of random levels.
const LATTICE: usize = 32;

/// The camera's picture of a world with soft spots of two sizes.
pub(crate) fn textured_world(
    header: &FrameHeader,
    world_from_camera: &UnitQuaternion<f64>,
) -> Vec<u8> {
    // The world is the same in each test.
    let mut dice = Dice::new(1);
    let levels: Vec<f64> =
        std::iter::repeat_with(|| dice.share() - 0.5).take(LATTICE * LATTICE * LATTICE).collect();
    let noise = |at: Vector3<f64>| {
        let [cell, within] = [at.map(f64::floor), at - at.map(f64::floor)];
        let corner = |k: usize| {
            let [x, y, z] = [0, 1, 2].map(|axis| {
                (cell[axis] as i64 + (k >> axis & 1) as i64).rem_euclid(LATTICE as i64) as usize
            });
            let weight = (0..3).map(|axis| match k >> axis & 1 {
                0 => 1.0 - within[axis],
                _ => within[axis],
            });
            weight.product::<f64>() * levels[(x * LATTICE + y) * LATTICE + z]
        };
        (0..8).map(corner).sum::<f64>()
    };
    // The spots are soft, so a large picture is drawn coarsely and smoothed.
    let step = (header.width / 1000).max(1);
    let [width, height] = [header.width, header.height].map(|side| side.div_ceil(step));
    let coarse = FrameHeader { width, height, stride: width, ..*header };
    let drawn = equirectangular(&coarse, |ray| {
        let ray = world_from_camera * ray;
        128.0 + 130.0 * noise(ray * 9.0) + 70.0 * noise(ray * 21.0)
    });
    enlarged(&drawn, &coarse, header)
}

/// A picture of the whole sphere in a larger size, with linear interpolation.
fn enlarged(pixels: &[u8], from: &FrameHeader, to: &FrameHeader) -> Vec<u8> {
    /// The first of the two source pixels around a pixel along one axis, and the weight of the
    /// second.
    fn between(at: u32, size: u32, of: u32) -> (i64, f32) {
        let place = (f64::from(at) + 0.5) * f64::from(of) / f64::from(size) - 0.5;
        (place.floor() as i64, (place - place.floor()) as f32)
    }
    let columns: Vec<(usize, usize, f32)> = (0..to.width)
        .map(|u| {
            let (left, near) = between(u, to.width, from.width);
            let wrapped = |column: i64| column.rem_euclid(i64::from(from.width)) as usize;
            (wrapped(left), wrapped(left + 1), near)
        })
        .collect();
    let mut larger = vec![0; (to.stride * to.height) as usize];
    for (v, row) in (0..).zip(larger.chunks_mut(to.stride as usize)) {
        let (top, near_v) = between(v, to.height, from.height);
        let [above, below] = [top, top + 1].map(|line| {
            let line = line.clamp(0, i64::from(from.height) - 1) as usize;
            &pixels[line * from.stride as usize..]
        });
        for (pixel, &(left, right, near_u)) in row.iter_mut().zip(&columns) {
            let mix = |line: &[u8]| {
                f32::from(line[left]) * (1.0 - near_u) + f32::from(line[right]) * near_u
            };
            *pixel = (mix(above) * (1.0 - near_v) + mix(below) * near_v).round() as u8;
        }
    }
    larger
}

/// Brightness of the sphere along a ray in the camera frame: smooth, and different in all
/// directions.
pub(crate) fn level(ray: &Vector3<f64>) -> f64 {
    let [x, y, z] = [ray.x, ray.y, ray.z];
    128.0 + 50.0 * x * (3.0 * y).cos() + 45.0 * (4.0 * z).sin() * y + 20.0 * z
}

/// The sphere as an equirectangular picture: rows of `stride` bytes.
pub(crate) fn sphere(header: &FrameHeader) -> Vec<u8> {
    equirectangular(header, |ray| level(&ray))
}

/// An equirectangular picture with the brightness `level` along each ray in the camera frame.
fn equirectangular(header: &FrameHeader, level: impl Fn(Vector3<f64>) -> f64) -> Vec<u8> {
    let (width, height, stride) = (header.width, header.height, header.stride as usize);
    let mut pixels = vec![0; stride * height as usize];
    let longitudes: Vec<(f64, f64)> = (0..width)
        .map(|u| {
            ((0.5 - (f64::from(u) + 0.5) / f64::from(width)) * std::f64::consts::TAU).sin_cos()
        })
        .collect();
    for (v, row) in pixels.chunks_mut(stride).enumerate() {
        let latitude = (0.5 - (v as f64 + 0.5) / f64::from(height)) * std::f64::consts::PI;
        let (up, level_part) = latitude.sin_cos();
        for (pixel, (sin, cos)) in row.iter_mut().zip(&longitudes) {
            let ray = Vector3::new(level_part * cos, level_part * sin, up);
            *pixel = level(ray).round() as u8;
        }
    }
    pixels
}
