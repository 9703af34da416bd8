//! Positions in the sphere image, in integers of 1/65536 px, and strips of pixels.

/// Largest error of the interpolated mapping along rows and columns of the sphere image, pixels.
pub const MAX_MAPPING_ERROR_PX: f64 = 0.02;

/// Fractional bits of a position in the sphere image.
pub(super) const FRACTION_BITS: u32 = 16;

/// One pixel as such an integer.
pub(super) const ONE: f64 = (1 << FRACTION_BITS) as f64;

/// Number of pixels that are mapped together.
pub(super) const LANES: usize = 8;

/// Positions of `LANES` pixels of a view in the sphere image: columns and rows, 1/65536 px.
pub(super) type Positions = ([i32; LANES], [i32; LANES]);

/// The column of a pixel that the sphere image does not show.
pub(super) const NOWHERE: i32 = i32::MIN;

/// Rounds to the nearest 1/65536 px.
#[inline(always)]
pub(super) fn fixed(pixels: f64) -> i32 {
    rounded(pixels * ONE)
}

/// The nearest integer of a number within 2^31. An arbitrary integer for any other number.
#[inline(always)]
pub(super) fn rounded(number: f64) -> i32 {
    // From 2^52 on, the last bit of a double counts ones. So the lower half of the sum is the
    // rounded number in two's complement. A cast would have to check for NaN and overflow.
    const ALIGN: f64 = 1.5 * (1u64 << 52) as f64;
    (number + ALIGN).to_bits() as i32
}

/// Writes a row of a strip into `out`, which begins with its first pixel.
#[inline(always)]
pub(super) fn put(out: &mut [u8], stride: usize, row: usize, greys: [u8; LANES]) {
    let at = row * stride;
    out[at..at + LANES].copy_from_slice(&greys);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_rounded_to_the_nearest_integer() {
        for number in [0.0, 0.4, -0.4, 0.6, -0.6, 65_535.7, -65_536.2, 2e9, -2e9] {
            assert_eq!(rounded(number), number.round() as i32, "{number}");
        }
    }
}
