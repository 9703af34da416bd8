//! The part of a view that shows a body, in linear light, no finer than is worth its time.

use nalgebra::{Isometry3, UnitQuaternion, Vector2, Vector3};

use super::Picture;
use super::geometry::Pinhole;

/// Pixels of which one part is saturated are told by this code value: cameras clip a little below
/// the end, and magnifying smooths.
const SATURATED: u8 = 252;

/// Linear light, row by row; NaN where a pixel says nothing.
#[derive(Debug, Clone)]
pub(super) struct Patch {
    pub width: usize,
    pub height: usize,
    pub light: Vec<f32>,
    pub pinhole: Pinhole,
    pub view_from_camera: UnitQuaternion<f64>,
    /// How the code values that the light was decoded from bend.
    pub code_bend: f64,
}

impl Patch {
    /// The patch round the sphere of `radius_m` about the body's origin at `camera_from_markers`, and
    /// `reach_rad` more.
    ///
    /// Blocks of the view's pixels are averaged (`step`). `None` where the view does not hold the
    /// body's middle.
    pub fn cut(
        picture: &Picture<'_>,
        camera_from_markers: &Isometry3<f64>,
        radius_m: f64,
        reach_rad: f64,
        widest_px: f64,
    ) -> Option<Self> {
        let Picture { image, view, light, .. } = picture;
        let view_from_camera = view.camera_from_view.inverse();
        let middle = view_from_camera * camera_from_markers.translation.vector;
        let range = middle.norm();
        // Written so that a NaN has no patch.
        if !(middle.z > 0.05 * range && range > radius_m) {
            return None;
        }
        let of_view =
            Pinhole { focal_px: view.focal_px, centre_px: Vector2::repeat(view.centre_px()) };
        let at = of_view.project(&middle)?;
        // Towards a view's rim a pinhole stretches radially by 1/cos^2.
        let stretch = (range / middle.z).powi(2);
        let margin = 1.05;
        let body = margin * view.focal_px * (radius_m / range).asin().tan() * stretch;
        let half = body + view.focal_px * reach_rad * stretch;
        let (width, height) = (image.width() as f64, image.height() as f64);
        let left = (at.x - half).floor().max(0.0);
        let top = (at.y - half).floor().max(0.0);
        let right = (at.x + half).ceil().min(width);
        let bottom = (at.y + half).ceil().min(height);
        if !(right - left >= 4.0 && bottom - top >= 4.0) {
            return None;
        }
        let step = step(picture, 2.0 * body, widest_px);
        let (left, top) = (left as usize, top as usize);
        let columns = (right as usize - left) / step;
        let rows = (bottom as usize - top) / step;
        if columns < 4 || rows < 4 {
            return None;
        }
        let mut pixels = vec![0.0f32; columns * rows];
        let table = light.table();
        let share = 1.0 / (step * step) as f32;
        for y in 0..rows {
            let out = &mut pixels[y * columns..][..columns];
            for line in 0..step {
                let row = &image.row(top + y * step + line)[left..];
                for (out, block) in out.iter_mut().zip(row.chunks_exact(step)) {
                    for &code in block {
                        // NaN stays NaN whatever is added.
                        *out += if code >= SATURATED { f32::NAN } else { table[usize::from(code)] };
                    }
                }
            }
            for out in out {
                *out *= share;
            }
        }
        let fine = step as f64;
        let first = Vector2::new(left as f64, top as f64).add_scalar((fine - 1.0) / 2.0);
        let pinhole = Pinhole {
            focal_px: view.focal_px / fine,
            centre_px: (of_view.centre_px - first) / fine,
        };
        let code_bend = light.bend();
        Some(Self {
            width: columns,
            height: rows,
            light: pixels,
            pinhole,
            view_from_camera,
            code_bend,
        })
    }

    /// The light of a pixel.
    #[inline]
    pub fn at(&self, x: usize, y: usize) -> f32 {
        self.light[y * self.width + x]
    }

    /// The light of the pixel nearest to a place, in the patch or at its rim. What is saturated is
    /// as light as can be.
    pub fn near(&self, x: f64, y: f64) -> f32 {
        let within = |at: f64, size: usize| (at.round().max(0.0) as usize).min(size - 1);
        let light = self.at(within(x, self.width), within(y, self.height));
        if light.is_nan() { 1.0 } else { light }
    }

    /// A pose in the camera frame as one in the patch's, whose axes are the view's.
    pub fn pose_in(&self, camera_from_markers: &Isometry3<f64>) -> Isometry3<f64> {
        self.view_from_camera * camera_from_markers
    }

    /// The patch blurred by a Gaussian of `deviation_px`. What is NaN stays out of it, and NaN.
    pub fn blurred(&self, deviation_px: f64) -> Self {
        let reach = (3.0 * deviation_px).ceil() as usize;
        let kernel: Vec<f32> =
            (0..=reach).map(|k| (-0.5 * (k as f64 / deviation_px).powi(2)).exp() as f32).collect();
        let across = convolve(&self.light, self.width, self.height, 1, self.width, &kernel);
        let light = convolve(&across, self.height, self.width, self.width, 1, &kernel);
        Self { light, ..self.clone() }
    }
}

/// Convolves `lines` lines of `length` values, `step` apart along a line and `stride` from line to
/// line, with a symmetric kernel; at the ends, and about NaN, with what there is of it.
fn convolve(
    values: &[f32],
    length: usize,
    lines: usize,
    step: usize,
    stride: usize,
    kernel: &[f32],
) -> Vec<f32> {
    let mut out = vec![f32::NAN; values.len()];
    for line in 0..lines {
        for at in 0..length {
            let place = line * stride + at * step;
            if values[place].is_nan() {
                continue;
            }
            let first = at.saturating_sub(kernel.len() - 1);
            let last = (at + kernel.len()).min(length);
            let (mut sum, mut weight) = (0.0, 0.0);
            for other in first..last {
                let value = values[line * stride + other * step];
                if !value.is_nan() {
                    sum += kernel[at.abs_diff(other)] * value;
                    weight += kernel[at.abs_diff(other)];
                }
            }
            out[place] = sum / weight;
        }
    }
    out
}

/// Pixels of a picture that are averaged, along a side: as many as keep the patch as fine as the
/// sphere image, and a body of `diameter_px` no wider than `widest_px`.
fn step(picture: &Picture<'_>, diameter_px: f64, widest_px: f64) -> usize {
    let for_sphere = picture.view.focal_px / picture.pixels_per_radian;
    let for_body = diameter_px / widest_px;
    for_sphere.max(for_body).floor().clamp(1.0, 64.0) as usize
}

/// The direction of a patch's pixel.
#[inline]
pub(super) fn direction(pinhole: &Pinhole, x: usize, y: usize) -> Vector3<f64> {
    pinhole.direction(Vector2::new(x as f64, y as f64))
}
