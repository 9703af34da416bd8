//! Hash functions and value noise: pseudo-random numbers that depend on their arguments alone.

/// Pseudo-random hash of a number (finaliser of SplitMix64, Steele et al. 2014).
pub(crate) fn mix(value: u64) -> u64 {
    let value = value.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let value = (value ^ (value >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let value = (value ^ (value >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    value ^ (value >> 31)
}

/// Pseudo-random number in [0, 1) for cell (`i`, `j`) of the pattern `seed`.
pub(crate) fn at_cell(seed: u64, i: i32, j: i32) -> f32 {
    let cell = u64::from(i.cast_unsigned()) << 32 | u64::from(j.cast_unsigned());
    (mix(seed ^ mix(cell)) >> 40) as f32 / (1u64 << 24) as f32
}

/// Floor of `x`, which must be in the range of `i32`. `f32::floor` is a slow function call here,
/// because SSE 4.1 is not assumed.
pub(crate) fn floor(x: f32) -> f32 {
    let towards_zero = x as i32 as f32;
    towards_zero - f32::from(u8::from(towards_zero > x))
}

/// Smooth values from 0 to 1 over the plane, about one bump for each unit: value noise.
pub(crate) fn clouds(seed: u64, x: f32, y: f32) -> f32 {
    let (i, j) = (floor(x), floor(y));
    let ease = |t: f32| t * t * (3.0 - 2.0 * t);
    let (s, t) = (ease(x - i), ease(y - j));
    let (i, j) = (i as i32, j as i32);
    let row = |j| at_cell(seed, i, j) * (1.0 - s) + at_cell(seed, i + 1, j) * s;
    row(j) * (1.0 - t) + row(j + 1) * t
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn floor_is_that_of_the_standard_library() {
        for k in -4000..4000 {
            let x = k as f32 / 7.0;
            assert_eq!(floor(x), x.floor(), "{x}");
            assert_eq!(floor(k as f32), k as f32);
        }
    }
}
