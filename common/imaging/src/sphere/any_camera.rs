//! The mapping into the image of any camera, by its camera model.

use flockeye_geometry::camera::{Camera, CameraModel, SpherePixel};
use flockeye_geometry::view::{View, ViewPixel};

use super::fixed_point::{LANES, NOWHERE, ONE, Positions, fixed};
use super::mapping::{Mapping, TileFit};
use super::patch::{NODE_COUNT, NODES, TilePositions, ViewTile};

/// A view of the image of a camera.
#[derive(Debug, Clone, Copy)]
pub(super) struct CameraMapping<'a> {
    camera: &'a Camera,
    view: &'a View,
    /// Columns after which the image repeats; 0 if it does not.
    turn: f64,
}

/// Points between the nodes where the first term that a quadratic omits is nearly largest.
const CHECKS: [[f64; 2]; 4] = [[-0.55, -0.55], [0.55, -0.55], [-0.55, 0.55], [0.55, 0.55]];

/// Largest error of the quadratic at the checked points, pixels. It is less than
/// [`super::patch::MAX_INTERPOLATION_ERROR_PX`], because between them the error may be larger.
const MAX_CHECKED_ERROR_PX: f64 = 0.008;

/// Tiles up to this side count as blank if the camera sees none of their nodes, pixels.
const BLANK_SIDE: u32 = 16;

impl<'a> CameraMapping<'a> {
    pub(super) fn new(camera: &'a Camera, view: &'a View) -> Self {
        let turn = match camera.model() {
            CameraModel::Equirectangular { .. } => f64::from(camera.width()),
            CameraModel::DualFisheye(_) | CameraModel::Stereographic { .. } => 0.0,
        };
        Self { camera, view, turn }
    }

    #[inline]
    fn point(&self, x: f64, y: f64) -> Option<SpherePixel> {
        self.camera.project(&self.view.ray(ViewPixel::new(x, y)))
    }

    /// Columns from `middle` to `column`, the shorter way around.
    fn columns_from(&self, middle: f64, column: f64) -> f64 {
        let columns = column - middle;
        if self.turn > 0.0 { columns - (columns / self.turn).round() * self.turn } else { columns }
    }
}

impl Mapping for CameraMapping<'_> {
    fn fit(&self, tile: ViewTile) -> TileFit {
        let half = [f64::from(tile.width) * 0.5, f64::from(tile.height) * 0.5];
        let centre = [f64::from(tile.x) + half[0] - 0.5, f64::from(tile.y) + half[1] - 0.5];
        let at = |across: f64, along: f64| {
            self.point(centre[0] + half[0] * across, centre[1] + half[1] * along)
        };
        let mut nodes = [None; NODE_COUNT];
        // The last three nodes repeat the fifth one, the middle.
        for k in 0..9 {
            nodes[k] = at(NODES[0][k], NODES[1][k]);
        }
        let middle = nodes[4];
        nodes[9..].fill(middle);
        if nodes.iter().all(Option::is_none) && tile.width.max(tile.height) <= BLANK_SIDE {
            return TileFit::Blank;
        }
        let Some(SpherePixel(middle)) = middle else { return TileFit::Split };
        let mut columns = [0.0; NODE_COUNT];
        let mut rows = [0.0; NODE_COUNT];
        for (k, node) in nodes.into_iter().enumerate() {
            let Some(SpherePixel(node)) = node else { return TileFit::Split };
            columns[k] = self.columns_from(middle.x, node.x) * ONE;
            rows[k] = (node.y - middle.y) * ONE;
        }
        let patch = TilePositions::through(tile, (middle.x, middle.y), &columns, &rows);
        for [across, along] in CHECKS {
            let Some(SpherePixel(exact)) = at(across, along) else { return TileFit::Split };
            let [column, row] = patch.offset_px(across, along);
            let column_error = self.columns_from(middle.x, exact.x) - column;
            let row_error = exact.y - middle.y - row;
            if column_error.abs().max(row_error.abs()) > MAX_CHECKED_ERROR_PX {
                return TileFit::Split;
            }
        }
        TileFit::Interpolated(patch)
    }

    fn positions(&self, x: u32, y: u32) -> Positions {
        let mut columns = [NOWHERE; LANES];
        let mut rows = [0; LANES];
        for k in 0..LANES {
            if let Some(SpherePixel(at)) = self.point(f64::from(x) + k as f64, f64::from(y)) {
                (columns[k], rows[k]) = (fixed(at.x), fixed(at.y));
            }
        }
        (columns, rows)
    }
}
