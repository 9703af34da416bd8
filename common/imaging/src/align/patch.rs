//! The part of a view that shows a body, as radiance, no finer than the fit needs.

use flockeye_geometry::camera::Stitch;
use flockeye_geometry::view::View;
use nalgebra::{Isometry3, UnitQuaternion, Vector2, Vector3};

use super::halves::Halves;
use super::pinhole::Pinhole;
use crate::image::LumaImage;
use crate::light::LinearLight;
use crate::sphere::MAGNIFIED;

/// Code values from here on count as saturated: cameras clip a little below the end of the range,
/// and magnification smooths.
const SATURATED: u8 = 252;

/// A view with its pixels.
#[derive(Debug, Clone, Copy)]
pub struct Picture<'p> {
    /// The pixels, as code values.
    pub image: LumaImage<'p>,
    /// The view that they show.
    pub view: View,
    /// The radiance that each code value stands for.
    pub light: &'p LinearLight,
    /// Resolution of the sphere image at the body. A view magnified beyond it has no more detail.
    pub pixels_per_radian: f64,
    /// Motion of the body during the exposure, as far as it is known.
    pub motion: Motion,
    /// How well `light` is known: standard deviation of the bend between black and white
    /// (the module `solve`). 0 for a response that is known exactly; a linear camera that is taken for
    /// sRGB has a bend of about -1.
    pub response_sigma: f64,
    /// The halves of a stitched picture; `None` where one lens has seen all of it.
    pub stitch: Option<Stitch>,
}

impl<'p> Picture<'p> {
    /// A view of a body with unknown motion.
    pub fn still(
        image: LumaImage<'p>,
        view: View,
        light: &'p LinearLight,
        pixels_per_radian: f64,
    ) -> Self {
        let motion = Motion::default();
        let (response_sigma, stitch) = (0.0, None);
        Self { image, view, light, pixels_per_radian, motion, response_sigma, stitch }
    }
}

/// Motion of a body across the line of sight during the exposure.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Motion {
    /// Apparent velocity of its middle in the camera's axes, rad/s. Zero if it is not known.
    pub rate_in_camera: Vector3<f64>,
    /// Exposure time, seconds; 0 if it is not known.
    pub exposure_s: f64,
}

/// Radiance of pixels, row by row.
#[derive(Debug, Clone)]
pub(super) struct Patch {
    pub width: usize,
    pub height: usize,
    pub radiance: Vec<f32>,
    /// Whether a pixel is saturated: its radiance is at least the stated value.
    saturated: Vec<bool>,
    pub pinhole: Pinhole,
    pub view_from_camera: UnitQuaternion<f64>,
    /// The halves of a stitched picture that show the body.
    pub halves: Halves,
    /// Radiance at which the sensor saturates.
    pub saturation: f64,
    /// Curvature of the camera's curve; see [`LinearLight::bend`].
    pub code_bend: f64,
    /// Variance of what smooths the patch after the camera has made code values, pixels squared:
    /// blocks of pixels, and interpolation between them.
    pub smoothing_px2: f64,
    /// Standard deviation of the Gaussian that blurred the patch, pixels.
    pub extra_blur_px: f64,
}

impl Patch {
    /// The patch that shows the sphere of `radius_m` about the body's origin at
    /// `camera_from_markers`, and `margin_rad` around it.
    ///
    /// Blocks of the view's pixels are averaged (see [`block_side`]). `None` where the view does
    /// not show the middle of the body.
    pub(super) fn cut(
        picture: &Picture<'_>,
        camera_from_markers: &Isometry3<f64>,
        radius_m: f64,
        margin_rad: f64,
        max_body_px: f64,
    ) -> Option<Self> {
        let Picture { image, view, light, .. } = picture;
        let view_from_camera = view.camera_from_view.inverse();
        let middle = view_from_camera * camera_from_markers.translation.vector;
        let range = middle.norm();
        // In this form a NaN gives no patch.
        if !(middle.z > 0.05 * range && range > radius_m) {
            return None;
        }
        let of_view =
            Pinhole { focal_px: view.focal_px, centre_px: Vector2::repeat(view.centre_px()) };
        let at = of_view.project(&middle)?;
        // Towards the rim of a view, a pinhole stretches radially by 1/cos^2.
        let stretch = (range / middle.z).powi(2);
        let margin = 1.05;
        let body = margin * view.focal_px * (radius_m / range).asin().tan() * stretch;
        let half = body + view.focal_px * margin_rad * stretch;
        let (width, height) = (image.width() as f64, image.height() as f64);
        let left = (at.x - half).floor().max(0.0);
        let top = (at.y - half).floor().max(0.0);
        let right = (at.x + half).ceil().min(width);
        let bottom = (at.y + half).ceil().min(height);
        if !(right - left >= 4.0 && bottom - top >= 4.0) {
            return None;
        }
        let step = block_side(picture, 2.0 * body, max_body_px);
        let (left, top) = (left as usize, top as usize);
        let columns = (right as usize - left) / step;
        let rows = (bottom as usize - top) / step;
        if columns < 4 || rows < 4 {
            return None;
        }
        let mut pixels = vec![0.0f32; columns * rows];
        let mut saturated = vec![false; columns * rows];
        let table = light.table();
        let share = 1.0 / (step * step) as f32;
        for y in 0..rows {
            let out = &mut pixels[y * columns..][..columns];
            let saturated = &mut saturated[y * columns..][..columns];
            for line in 0..step {
                let row = &image.row(top + y * step + line)[left..];
                let pixels = out.iter_mut().zip(saturated.iter_mut());
                for ((out, saturated), block) in pixels.zip(row.chunks_exact(step)) {
                    for &code in block {
                        *out += table[usize::from(code)];
                        *saturated |= code >= SATURATED;
                    }
                }
            }
            for out in out {
                *out *= share;
            }
        }
        let fine = step as f64;
        // Linear interpolation at a share f of a pixel has the variance f (1 - f), on average a sixth.
        // The cubic has nearly none.
        let magnification = view.focal_px / picture.pixels_per_radian;
        let is_cubic = magnification > MAGNIFIED;
        let interpolated_px2 = if is_cubic { 0.0 } else { magnification.powi(2) / 6.0 };
        let averaged_px2 = (fine.powi(2) - 1.0) / 12.0;
        let first = Vector2::new(left as f64, top as f64).add_scalar((fine - 1.0) / 2.0);
        let pinhole = Pinhole {
            focal_px: view.focal_px / fine,
            centre_px: (of_view.centre_px - first) / fine,
        };
        Some(Self {
            width: columns,
            height: rows,
            radiance: pixels,
            saturated,
            pinhole,
            view_from_camera,
            halves: Halves::of(picture, &camera_from_markers.translation.vector, radius_m),
            saturation: f64::from(light.of(u8::MAX)),
            code_bend: light.bend(),
            smoothing_px2: (averaged_px2 + interpolated_px2) / fine.powi(2),
            extra_blur_px: 0.0,
        })
    }

    /// The radiance of a pixel; a lower bound where it is saturated.
    #[inline]
    pub(super) fn at(&self, x: usize, y: usize) -> f32 {
        self.radiance[y * self.width + x]
    }

    /// Whether a pixel shows this half of a stitched picture, and no other.
    #[inline]
    pub(super) fn shows_half(&self, half: u8, x: usize, y: usize) -> bool {
        self.halves.shows(half, &self.pinhole.direction(Vector2::new(x as f64, y as f64)))
    }

    /// Whether the radiance of a pixel may exceed the stated value.
    #[inline]
    pub(super) fn is_saturated(&self, x: usize, y: usize) -> bool {
        self.saturated[y * self.width + x]
    }

    /// The share of the pixels that are saturated.
    pub(super) fn saturated_share(&self) -> f64 {
        let count = self.saturated.iter().filter(|saturated| **saturated).count();
        count as f64 / self.saturated.len() as f64
    }

    /// The radiance between pixels, interpolated linearly; outside the patch, that of its rim.
    #[inline]
    pub(super) fn between(&self, at: Vector2<f64>) -> f32 {
        let within = |at: f64, size: usize| {
            let at = at.clamp(0.0, (size - 1) as f64);
            let low = (at as usize).min(size.saturating_sub(2));
            (low, (low + 1).min(size - 1), (at - low as f64) as f32)
        };
        let (left, right, across) = within(at.x, self.width);
        let (top, bottom, down) = within(at.y, self.height);
        let row = |y| self.at(left, y) * (1.0 - across) + self.at(right, y) * across;
        row(top) * (1.0 - down) + row(bottom) * down
    }

    /// The radiance of the pixel nearest to a point, at the rim for points outside.
    pub(super) fn nearest(&self, x: f64, y: f64) -> f32 {
        let within = |at: f64, size: usize| (at.round().max(0.0) as usize).min(size - 1);
        self.at(within(x, self.width), within(y, self.height))
    }

    /// The patch blurred by a Gaussian of this deviation. The same pixels stay saturated.
    pub(super) fn blurred(&self, sigma_px: f64) -> Self {
        let radiance = smoothed(&self.radiance, self.width, self.height, sigma_px);
        Self { radiance, extra_blur_px: sigma_px, ..self.clone() }
    }
}

/// Values, row by row, blurred by a Gaussian of standard deviation `sigma_px`.
pub(super) fn smoothed(values: &[f32], width: usize, height: usize, sigma_px: f64) -> Vec<f32> {
    let reach = (3.0 * sigma_px).ceil() as usize;
    let kernel: Vec<f32> =
        (0..=reach).map(|k| (-0.5 * (k as f64 / sigma_px).powi(2)).exp() as f32).collect();
    let across = convolve(values, width, height, 1, width, &kernel);
    convolve(&across, height, width, width, 1, &kernel)
}

/// Convolves `lines` lines of `length` values with a symmetric kernel.
///
/// Values are `step` apart along a line and `stride` apart from line to line. At the ends the
/// kernel is normalized over the values that exist.
fn convolve(
    values: &[f32],
    length: usize,
    lines: usize,
    step: usize,
    stride: usize,
    kernel: &[f32],
) -> Vec<f32> {
    let mut out = vec![0.0; values.len()];
    for line in 0..lines {
        for at in 0..length {
            let place = line * stride + at * step;
            let first = at.saturating_sub(kernel.len() - 1);
            let last = (at + kernel.len()).min(length);
            let (mut sum, mut weight) = (0.0, 0.0);
            for other in first..last {
                sum += kernel[at.abs_diff(other)] * values[line * stride + other * step];
                weight += kernel[at.abs_diff(other)];
            }
            out[place] = sum / weight;
        }
    }
    out
}

/// Side of the blocks of pixels that are averaged: the patch is no finer than the sphere image, and
/// a body of `diameter_px` no wider than `max_body_px`.
fn block_side(picture: &Picture<'_>, diameter_px: f64, max_body_px: f64) -> usize {
    let for_sphere = picture.view.focal_px / picture.pixels_per_radian;
    let for_body = diameter_px / max_body_px;
    for_sphere.max(for_body).floor().clamp(1.0, 64.0) as usize
}
