//! The exact mapping from a view's pixels to the sphere image's.

use std::f64::consts::{FRAC_1_PI, TAU};

use flockeye_geometry::camera::Equirectangular;
use flockeye_geometry::view::View;
use nalgebra::Vector3;

use super::angle::atan2;

/// Fractions of a pixel in the integers that positions in the sphere image are counted in: 65,536.
pub(super) const FRACTION_BITS: u32 = 16;

/// One pixel in those integers.
pub(super) const ONE: f64 = (1 << FRACTION_BITS) as f64;

/// Pixels that are mapped together.
pub(super) const LANES: usize = 8;

/// Where `LANES` pixels of a view lie in the sphere image: columns and rows, 1/65536 px.
pub(super) type Positions = ([i32; LANES], [i32; LANES]);

/// A view over a sphere image. Directions are in the camera frame, in units of the view's pixels:
/// the view's plane lies `focal_px` away.
#[derive(Debug, Clone, Copy)]
pub(super) struct Mapping {
    /// Direction of the view's first pixel.
    corner: Vector3<f64>,
    /// From one pixel to its right neighbour.
    pub(super) right: Vector3<f64>,
    /// From one pixel to the one below.
    pub(super) down: Vector3<f64>,
    /// Focal length, pixels.
    pub(super) focal_px: f64,
    /// Sides of the sphere image, pixels.
    width: f64,
    height: f64,
}

impl Mapping {
    pub(super) fn new(camera: Equirectangular, view: &View) -> Self {
        let axes = view.camera_from_view.to_rotation_matrix();
        let axis = |k| axes.matrix().column(k).into_owned();
        let (right, down): (Vector3<f64>, Vector3<f64>) = (axis(0), axis(1));
        Self {
            corner: axis(2) * view.focal_px - (right + down) * view.centre_px(),
            right,
            down,
            focal_px: view.focal_px,
            width: f64::from(camera.width),
            height: f64::from(camera.height),
        }
    }

    /// Direction of the view's point (x, y).
    #[inline(always)]
    pub(super) fn direction(&self, x: f64, y: f64) -> Vector3<f64> {
        self.corner + self.right * x + self.down * y
    }

    /// Columns of the sphere image for each radian of longitude.
    #[inline(always)]
    pub(super) fn columns_per_radian(&self) -> f64 {
        self.width / TAU
    }

    /// Rows for each radian of latitude.
    #[inline(always)]
    pub(super) fn rows_per_radian(&self) -> f64 {
        self.height * FRAC_1_PI
    }

    /// The point of the sphere image in `direction`: column in [-0.5, W - 0.5], row in
    /// [-0.5, H - 0.5], pixels.
    #[inline(always)]
    pub(super) fn point(&self, x: f64, y: f64, z: f64) -> (f64, f64) {
        let longitude = atan2(y, x);
        let latitude = atan2(z, (x * x + y * y).sqrt());
        (
            self.width * 0.5 - 0.5 - longitude * self.columns_per_radian(),
            self.height * 0.5 - 0.5 - latitude * self.rows_per_radian(),
        )
    }

    /// Exact positions of the `LANES` pixels from (x, y) to the right.
    #[inline(always)]
    pub(super) fn positions(&self, x: u32, y: u32) -> Positions {
        let first = self.direction(f64::from(x), f64::from(y));
        let mut columns = [0; LANES];
        let mut rows = [0; LANES];
        for k in 0..LANES {
            let step = k as f64;
            let (column, row) = self.point(
                first.x + self.right.x * step,
                first.y + self.right.y * step,
                first.z + self.right.z * step,
            );
            columns[k] = fixed(column);
            rows[k] = fixed(row);
        }
        (columns, rows)
    }
}

/// To the nearest 1/65536 px.
#[inline(always)]
pub(super) fn fixed(pixels: f64) -> i32 {
    rounded(pixels * ONE)
}

/// The nearest integer of a number within 2^31; some integer of any other.
#[inline(always)]
pub(super) fn rounded(number: f64) -> i32 {
    // From 2^52 on a double's last binary digit counts ones, so the sum's lower half is the
    // rounded number in two's complement. A cast would have to look at each for NaN and overflow.
    const ALIGN: f64 = 1.5 * (1u64 << 52) as f64;
    (number + ALIGN).to_bits() as i32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rounding_is_to_the_nearest() {
        for number in [0.0, 0.4, -0.4, 0.6, -0.6, 65_535.7, -65_536.2, 2e9, -2e9] {
            assert_eq!(rounded(number), number.round() as i32, "{number}");
        }
    }
}
