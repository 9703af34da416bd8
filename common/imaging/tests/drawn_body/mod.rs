//! Pictures of bodies, rendered by sampling, then blurred and encoded as by a camera. They do not
//! use the model of alignment.

use std::collections::BTreeMap;

use flockeye_geometry::Ray;
use flockeye_geometry::body::{Body, Facet};
use flockeye_geometry::view::{View, ViewPixel};
use flockeye_imaging::edges::MarkerPrint;
use flockeye_imaging::image::LumaImage;
use nalgebra::{Isometry3, Point3, Unit};

/// Prints of five by five cells, seventeen of them, all different.
pub(crate) fn prints() -> BTreeMap<u32, MarkerPrint> {
    let mut state = 0x2545_f491_u64;
    let mut random = move || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        state
    };
    (0..34)
        .map(|id| {
            let cells: Vec<bool> = (0..25).map(|_| random() >> 40 & 1 == 1).collect();
            (id, MarkerPrint::of_bits(&cells).unwrap())
        })
        .collect()
}

/// A picture of a body at a known pose.
pub(crate) struct Drawing {
    /// Code values.
    pub pixels: Vec<u8>,
    /// The view that they show.
    pub view: View,
}

impl Drawing {
    /// The image.
    pub(crate) fn image(&self) -> LumaImage<'_> {
        let size = self.view.size_px as usize;
        LumaImage::new(&self.pixels, size, size, size).unwrap()
    }
}

/// Radiance of the point of the body that `ray` hits, by testing each facet.
fn radiance_of(
    body: &Body,
    prints: &BTreeMap<u32, MarkerPrint>,
    markers_from_camera: &Isometry3<f64>,
    ray: &Ray,
    background: f64,
) -> f64 {
    let eye = markers_from_camera * Point3::origin();
    let direction = markers_from_camera * ray.into_inner();
    for (index, facet) in body.facets().iter().enumerate() {
        let towards = facet.normal.dot(&direction);
        let height = facet.normal.dot(&(eye - facet.outline[0]));
        // Seen from its front.
        if height <= 0.0 || towards >= 0.0 {
            continue;
        }
        let at = eye - direction * (height / towards);
        if !is_inside(facet, &at) {
            continue;
        }
        // Each facet has its own radiance.
        let white = 0.35 + 0.04 * (index % 11) as f64;
        let Some(marker) = facet.marker.map(|marker| &body.markers[marker]) else {
            return 0.8 * white;
        };
        let print = &prints[&marker.id];
        let [origin, right, _, bottom] = marker.corners;
        let along = |end: Point3<f64>| {
            let axis = end - origin;
            axis.dot(&(at - origin)) / axis.norm_squared() * print.cells() as f64
        };
        let (column, row) = (along(right).floor() as isize, along(bottom).floor() as isize);
        return if print.is_white(row, column) { white } else { 0.05 * white };
    }
    background
}

fn is_inside(facet: &Facet, at: &Point3<f64>) -> bool {
    let count = facet.outline.len();
    (0..count).all(|k| {
        let (from, to) = (facet.outline[k], facet.outline[(k + 1) % count]);
        (to - from).cross(&(at - from)).dot(&facet.normal) >= 0.0
    })
}

/// Samples along a side of each pixel.
const FINE: usize = 5;

/// Weights of the samples around and in a pixel: a Gaussian, integrated over the pixel.
fn kernel(blur_px: f64) -> Vec<f64> {
    let sigma = blur_px * FINE as f64;
    let reach = (4.0 * sigma).ceil() as i32;
    let weight = |sample: i32| -> f64 {
        (0..FINE as i32).map(|own| (-0.5 * (f64::from(sample - own) / sigma).powi(2)).exp()).sum()
    };
    let weights: Vec<f64> = (-reach..FINE as i32 + reach).map(weight).collect();
    let total: f64 = weights.iter().sum();
    weights.iter().map(|weight| weight / total).collect()
}

/// Blurs rows of fine samples into `count` pixels each, and transposes them, so that a second call
/// blurs the columns.
fn blurred(samples: &[f64], count: usize, rows: usize, kernel: &[f64]) -> Vec<f64> {
    let length = count * FINE;
    let before = (kernel.len() - FINE) / 2;
    let mut pixels = vec![0.0; count * rows];
    for (y, row) in samples.chunks_exact(length).enumerate() {
        for x in 0..count {
            let at = |k: usize| (x * FINE + k).saturating_sub(before).min(length - 1);
            let sum = kernel.iter().enumerate().map(|(k, weight)| weight * row[at(k)]).sum();
            pixels[x * rows + y] = sum;
        }
    }
    pixels
}

/// Renders what a view of `focal_px` sees. The radiance is sampled 5 by 5 in each pixel, blurred by
/// `blur_px` and integrated over the pixels. Noise is added, and the result is encoded as sRGB with
/// 8 bits.
pub(crate) fn draw(
    body: &Body,
    pose: &Isometry3<f64>,
    focal_px: f64,
    blur_px: f64,
    noise: f64,
) -> Drawing {
    draw_mixed(body, pose, focal_px, blur_px, noise, |_| [(1.0, *pose), (0.0, *pose)])
}

/// As [`draw`], with two poses of the body in each ray and the share of each: two lenses whose
/// pictures have been blended. The view looks at `pose`.
pub(crate) fn draw_mixed(
    body: &Body,
    pose: &Isometry3<f64>,
    focal_px: f64,
    blur_px: f64,
    noise: f64,
    shown: impl Fn(&Ray) -> [(f64, Isometry3<f64>); 2],
) -> Drawing {
    let prints = prints();
    let direction = Unit::new_normalize(pose.translation.vector);
    let size = (2.0 * focal_px * 0.13 / pose.translation.vector.norm()).ceil() as u32 + 12;
    let field = 2.0 * (f64::from(size) / (2.0 * focal_px)).atan();
    let view = View::looking_at(&direction, field, size);
    let side = size as usize;
    let mut radiances = vec![0.0; (side * FINE).pow(2)];
    for (k, radiance) in radiances.iter_mut().enumerate() {
        let place = |sample: usize| (sample as f64 + 0.5) / FINE as f64 - 0.5;
        let (x, y) = (place(k % (side * FINE)), place(k / (side * FINE)));
        let background = 0.2 + 0.1 * (x / 3.0).sin();
        let ray = view.ray(ViewPixel::new(x, y));
        let shown = shown(&ray).into_iter().filter(|(share, _)| *share > 0.0);
        *radiance = shown
            .map(|(share, pose)| {
                share * radiance_of(body, &prints, &pose.inverse(), &ray, background)
            })
            .sum();
    }
    let kernel = kernel(blur_px);
    let across = blurred(&radiances, side, side * FINE, &kernel);
    let radiances = blurred(&across, side, side, &kernel);
    let mut state = 7u64;
    let mut random = move || {
        state =
            state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as f64 / f64::from(1u32 << 31) - 0.5
    };
    let pixels = radiances
        .iter()
        .map(|radiance| {
            // A sum of twelve uniform numbers has a variance of one.
            let normal: f64 = (0..12).map(|_| random()).sum();
            let noisy = (radiance + noise * normal).clamp(0.0, 1.0);
            let code = if noisy <= 0.003_130_8 {
                12.92 * noisy
            } else {
                1.055 * noisy.powf(1.0 / 2.4) - 0.055
            };
            (code * 255.0).round() as u8
        })
        .collect();
    Drawing { pixels, view }
}
