//! The mapping into an equirectangular image with one centre, with a known bound of the
//! interpolation error, and with angles by polynomials.

use std::f64::consts::{FRAC_1_PI, TAU};

use flockeye_geometry::camera::Equirectangular;
use flockeye_geometry::view::View;
use nalgebra::Vector3;

use super::angle::{atan, atan2};
use super::fixed_point::{LANES, ONE, Positions, fixed};
use super::mapping::{Mapping, TileFit};
use super::patch::{MAX_INTERPOLATION_ERROR_PX, NODE_COUNT, NODES, TilePositions, ViewTile};

/// A view of a sphere image. Directions are in the camera frame, in pixels of the view: the view's
/// plane lies `focal_px` away.
#[derive(Debug, Clone, Copy)]
pub(super) struct EquirectangularMapping {
    /// Direction of the view's first pixel.
    corner: Vector3<f64>,
    /// Vector from one pixel to its right neighbour.
    right: Vector3<f64>,
    /// Vector from one pixel to the one below.
    down: Vector3<f64>,
    focal_px: f64,
    /// Sides of the sphere image, pixels.
    width: f64,
    height: f64,
}

impl EquirectangularMapping {
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
    fn direction(&self, x: f64, y: f64) -> Vector3<f64> {
        self.corner + self.right * x + self.down * y
    }

    /// Columns of the sphere image for each radian of longitude.
    #[inline(always)]
    fn columns_per_radian(&self) -> f64 {
        self.width / TAU
    }

    /// Rows for each radian of latitude.
    #[inline(always)]
    fn rows_per_radian(&self) -> f64 {
        self.height * FRAC_1_PI
    }

    /// The point of the sphere image in `direction`: column in [-0.5, W - 0.5], row in
    /// [-0.5, H - 0.5], pixels.
    #[inline(always)]
    fn point(&self, x: f64, y: f64, z: f64) -> (f64, f64) {
        let longitude = atan2(y, x);
        let latitude = atan2(z, (x * x + y * y).sqrt());
        (
            self.width * 0.5 - 0.5 - longitude * self.columns_per_radian(),
            self.height * 0.5 - 0.5 - latitude * self.rows_per_radian(),
        )
    }
}

impl Mapping for EquirectangularMapping {
    /// The error bound of the columns is strict. Longitude is the imaginary part of log(w) for
    /// w = x + iy, and w is linear over the view's plane. So the third derivative along a step s is
    /// at most 2 |s/w|^3. Quadratic interpolation through -1, 0, 1 leaves at most sqrt(3)/27 of it.
    /// Interpolation along the other coordinate adds 5/4 of the error along that coordinate.
    ///
    /// The bound of the rows, 1 + 1/|w|^2 in units of the focal length, is an envelope of the
    /// errors found over random tiles.
    #[inline(always)]
    fn fit(&self, tile: ViewTile) -> TileFit {
        let (half_width, half_height) = (f64::from(tile.width) * 0.5, f64::from(tile.height) * 0.5);
        let middle = self
            .direction(f64::from(tile.x) + half_width - 0.5, f64::from(tile.y) + half_height - 0.5);
        let (right, down) = (self.right * half_width, self.down * half_height);

        let radius = length(middle.x, middle.y);
        let (reach_x, reach_y) = (length(right.x, right.y), length(down.x, down.y));
        let nearest = radius - reach_x - reach_y;
        // The pole is farther than the tile is wide: angles from its middle are below 45 degrees.
        if nearest <= radius * 0.5 {
            return TileFit::Split;
        }
        let remainder = |x: f64, y: f64| 3f64.sqrt() / 27.0 * (x.powi(3) + 1.25 * y.powi(3));
        let column_error =
            2.0 * self.columns_per_radian() * remainder(reach_x / nearest, reach_y / nearest);
        let near = (nearest / self.focal_px).min(1.0);
        let row_error = (1.0 + 1.0 / (near * near))
            * self.rows_per_radian()
            * remainder(half_width / self.focal_px, half_height / self.focal_px);
        if column_error > MAX_INTERPOLATION_ERROR_PX || row_error > MAX_INTERPOLATION_ERROR_PX {
            return TileFit::Split;
        }

        let [across_nodes, along_nodes] = NODES;
        let mut columns = [0.0; NODE_COUNT];
        let mut rows = [0.0; NODE_COUNT];
        let column_scale = -self.columns_per_radian() * ONE;
        let row_scale = -self.rows_per_radian() * ONE;
        for k in 0..NODE_COUNT {
            let dx = right.x * across_nodes[k] + down.x * along_nodes[k];
            let dy = right.y * across_nodes[k] + down.y * along_nodes[k];
            let dz = right.z * across_nodes[k] + down.z * along_nodes[k];
            // Angles relative to the middle's longitude and latitude, as arguments of complex
            // quotients.
            let turned = dy * middle.x - dx * middle.y;
            let ahead = radius * radius + dx * middle.x + dy * middle.y;
            columns[k] = column_scale * atan(turned / ahead);
            let (x, y, z) = (middle.x + dx, middle.y + dy, middle.z + dz);
            let across = length(x, y);
            let risen = z * radius - across * middle.z;
            let level = across * radius + z * middle.z;
            rows[k] = row_scale * atan(risen / level);
        }
        let longitude = atan2(middle.y, middle.x);
        let latitude = atan2(middle.z, radius);
        let centre = (
            self.columns_per_radian() * (std::f64::consts::PI - longitude) - 0.5,
            self.rows_per_radian() * (std::f64::consts::FRAC_PI_2 - latitude) - 0.5,
        );
        TileFit::Interpolated(TilePositions::through(tile, centre, &columns, &rows))
    }

    #[inline(always)]
    fn positions(&self, x: u32, y: u32) -> Positions {
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

#[inline(always)]
fn length(x: f64, y: f64) -> f64 {
    (x * x + y * y).sqrt()
}
