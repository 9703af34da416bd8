//! Cubic convolution in integers, so that every back end gives the same bytes.

/// Bits of a weight: 1 is 2^14.
pub(super) const WEIGHT_BITS: u32 = 14;

/// Bits dropped after a row of pixels was weighted, so that the sum fits into 16 bits.
pub(super) const ROW_SHIFT: u32 = 8;

/// Bits dropped at the end.
pub(super) const END_SHIFT: u32 = 2 * WEIGHT_BITS - ROW_SHIFT;

/// Half of 1 in a product of two numbers of 15 fractional bits, for rounding.
const HALF: i32 = 1 << 14;

/// A product of two fractions of 15 bits, rounded to 15 bits.
#[inline(always)]
fn product(a: i32, b: i32) -> i32 {
    (a * b + HALF) >> 15
}

/// Weights of four neighbours for a position `fraction` (1/65536) behind the second. They sum to 1.
#[inline(always)]
pub(super) fn weights(fraction: i32) -> [i32; 4] {
    let t = (fraction & 0xffff) >> 1;
    let square = product(t, t);
    let cube = product(square, t);
    let one = 1 << WEIGHT_BITS;
    let first = ((square - cube) + (square - t)) >> 2;
    let second = one + ((3 * (cube - square)) >> 2) - (square >> 1);
    let last = (cube - square) >> 2;
    [first, second, one - first - second - last, last]
}

/// The grey value at a position between the middle four of `pixels`, given row by row. The position
/// is (column, row) in 1/65536 px, of which only the fractions count.
#[inline(always)]
pub(super) fn blend([column, row]: [i32; 2], pixels: [[u8; 4]; 4]) -> u8 {
    let (across, along) = (weights(column), weights(row));
    let weighted = |values: [i32; 4], weights: [i32; 4]| -> i32 {
        values.into_iter().zip(weights).map(|(value, weight)| value * weight).sum()
    };
    let rows = pixels
        .map(|line| (weighted(line.map(i32::from), across) + (1 << (ROW_SHIFT - 1))) >> ROW_SHIFT);
    let grey = (weighted(rows, along) + (1 << (END_SHIFT - 1))) >> END_SHIFT;
    grey.clamp(0, 255) as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_are_those_of_the_cubic_convolution() {
        for fraction in (0..65_536).step_by(7) {
            let t = f64::from(fraction) / 65_536.0;
            let exact = [
                -0.5 * t * (1.0 - t) * (1.0 - t),
                1.0 - 2.5 * t * t + 1.5 * t * t * t,
                0.5 * t * (1.0 + 4.0 * t - 3.0 * t * t),
                -0.5 * t * t * (1.0 - t),
            ];
            let found = weights(fraction);
            assert_eq!(found.iter().sum::<i32>(), 1 << WEIGHT_BITS);
            for (found, exact) in found.into_iter().zip(exact) {
                assert!((f64::from(found) / 16_384.0 - exact).abs() < 3e-4, "{fraction}");
            }
        }
    }

    #[test]
    fn parabolas_are_reproduced() {
        let height = |x: f64| 20.0 + 15.0 * x + 9.0 * x * x;
        let line = [-1.0, 0.0, 1.0, 2.0].map(|x| height(x) as u8);
        for fraction in (0..65_536).step_by(97) {
            let found = f64::from(blend([fraction, 40_000], [line; 4]));
            let exact = height(f64::from(fraction) / 65_536.0);
            assert!((found - exact).abs() < 0.6, "{fraction}: {found} {exact}");
        }
    }

    #[test]
    fn overshoot_is_clamped_to_black_and_white() {
        assert_eq!(blend([40_000, 0], [[0, 0, 0, 255]; 4]), 0);
        assert_eq!(blend([40_000, 0], [[255, 255, 255, 0]; 4]), 255);
    }
}
