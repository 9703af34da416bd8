//! Views cut from the sphere.

use std::f32::consts::{PI, TAU};

use flockeye_contract::{FrameHeader, PlannedView};
use nalgebra::{Quaternion, UnitQuaternion, Vector3};

/// A planned view's rotation at an exposure: it turns by its rate from the time for which it was planned.
pub fn turned(planned: &PlannedView, exposure_ns: i64) -> UnitQuaternion<f64> {
    let camera_from_view =
        UnitQuaternion::from_quaternion(Quaternion::from(planned.camera_from_view));
    if planned.reference_ns == 0 {
        return camera_from_view;
    }
    let since_s = exposure_ns.saturating_sub(planned.reference_ns) as f64 * 1e-9;
    let turn = Vector3::from(planned.rate_in_camera) * since_s;
    UnitQuaternion::from_scaled_axis(turn) * camera_from_view
}

/// An equirectangular picture. `luma` has at least `stride * height` bytes: the contract's check of a frame
/// has seen to that.
pub struct Sphere<'p> {
    luma: &'p [u8],
    width: i64,
    height: i64,
    stride: usize,
}

impl<'p> Sphere<'p> {
    /// The picture that a frame shows.
    pub fn new(frame: &FrameHeader, luma: &'p [u8]) -> Self {
        Self {
            luma,
            width: frame.width.into(),
            height: frame.height.into(),
            stride: frame.stride as usize,
        }
    }

    /// Cuts a pinhole image of `size_px` rows and columns, its principal point in the middle, into `view`.
    pub fn cut(
        &self,
        camera_from_view: &UnitQuaternion<f64>,
        focal_px: f64,
        size_px: u32,
        view: &mut [u8],
    ) {
        let camera_from_view = camera_from_view.cast::<f32>().to_rotation_matrix();
        let centre_px = (size_px - 1) as f32 / 2.0;
        let at = |pixel: usize| (pixel as f32 - centre_px) / focal_px as f32;
        for (row, pixels) in view.chunks_exact_mut(size_px as usize).enumerate() {
            for (column, pixel) in pixels.iter_mut().enumerate() {
                let ray_in_view = Vector3::new(at(column), at(row), 1.0);
                *pixel = self.level(&(camera_from_view * ray_in_view));
            }
        }
    }

    /// The luma along a ray of any length in the camera frame, between the four pixels around it.
    fn level(&self, ray: &Vector3<f32>) -> u8 {
        let longitude = ray.y.atan2(ray.x);
        let latitude = ray.z.atan2(ray.x.hypot(ray.y));
        let u = (0.5 - longitude / TAU) * self.width as f32 - 0.5;
        let v = (0.5 - latitude / PI) * self.height as f32 - 0.5;
        let (s, t) = (u - u.floor(), v - v.floor());
        // Columns go round; rows end at the poles.
        let columns = [0, 1].map(|k| (u.floor() as i64 + k).rem_euclid(self.width) as usize);
        let rows = [0, 1].map(|k| (v.floor() as i64 + k).clamp(0, self.height - 1) as usize);
        let [above, below] = rows.map(|row| {
            let row = row * self.stride;
            let [first, second] = columns.map(|column| f32::from(self.luma[row + column]));
            (1.0 - s) * first + s * second
        });
        ((1.0 - t) * above + t * below + 0.5) as u8
    }
}
