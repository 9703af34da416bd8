//! The mapping from a view's pixels to the sphere image's.

use super::patch::{Patch, Tile};

/// Fractions of a pixel in the integers that positions in the sphere image are counted in: 65,536.
pub(super) const FRACTION_BITS: u32 = 16;

/// One pixel in those integers.
pub(super) const ONE: f64 = (1 << FRACTION_BITS) as f64;

/// Pixels that are mapped together.
pub(super) const LANES: usize = 8;

/// Where `LANES` pixels of a view lie in the sphere image: columns and rows, 1/65536 px.
pub(super) type Positions = ([i32; LANES], [i32; LANES]);

/// The column of a pixel that no part of the sphere image sees.
pub(super) const NOWHERE: i32 = i32::MIN;

/// Where a view's pixels lie in the sphere image.
pub(super) trait Mapping {
    /// Interpolates the mapping over `tile`, if that can be done closely enough.
    fn fit(&self, tile: Tile) -> Fit;

    /// Exact positions of the `LANES` pixels from (x, y) to the right; [`NOWHERE`] as the column of
    /// those that the sphere image does not show.
    fn positions(&self, x: u32, y: u32) -> Positions;
}

/// How a tile is mapped.
pub(super) enum Fit {
    /// By this interpolation.
    Patch(Patch),
    /// Not as a whole: it must be split.
    Split,
    /// The sphere image shows none of it.
    Blank,
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
