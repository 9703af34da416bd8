//! The mapping from a view's pixels to the sphere image's.

use super::fixed_point::Positions;
use super::patch::{TilePositions, ViewTile};

/// Where a view's pixels lie in the sphere image.
pub(super) trait Mapping {
    /// Interpolates the mapping over `tile`, if that is precise enough.
    fn fit(&self, tile: ViewTile) -> TileFit;

    /// Exact positions of the `LANES` pixels from (x, y) to the right. The column is `NOWHERE` for
    /// pixels that the sphere image does not show.
    fn positions(&self, x: u32, y: u32) -> Positions;
}

/// How a tile is mapped.
pub(super) enum TileFit {
    /// By this interpolation.
    Interpolated(TilePositions),
    /// The tile must be split.
    Split,
    /// The sphere image shows none of it.
    Blank,
}
