//! The mapping from a view's pixels to the sphere image's.

use super::fixed_point::Positions;
use super::patch::{TilePositions, ViewTile};

/// Mapping from a view's pixels to positions in the sphere image.
pub(super) trait Mapping {
    /// Interpolates the mapping over `tile`, if that is precise enough.
    fn fit(&self, tile: ViewTile) -> TileFit;

    /// Exact positions of the `LANES` pixels from (x, y) to the right. The column is `NOWHERE` for
    /// pixels outside the sphere image.
    fn positions(&self, x: u32, y: u32) -> Positions;
}

/// Mapping of a tile.
pub(super) enum TileFit {
    /// Mapped by this interpolation.
    Interpolated(TilePositions),
    /// The tile must be split.
    Split,
    /// The whole tile lies outside the sphere image.
    Blank,
}
