//! Cuts strips of eight columns at once, with AVX2.

use std::arch::x86_64::*;

use super::cubic;
use super::fetch::fetch;
use super::fixed_point::{LANES, put};
use super::image::SphereImage;
use super::patch::{MAX_ROWS, Strip};
use super::sample::{ROW_WEIGHT, WEIGHT_BITS};

/// Longest stride that fits the 16-bit factors of the addresses, bytes.
pub(super) const MAX_STRIDE: usize = i16::MAX as usize;

/// Cuts one strip into the first `rows` rows of `out`, bilinearly. Its positions must lie between
/// the image's first and last but one column and row. The grey values are those of
/// [`super::sample::sample`].
///
/// # Safety
/// This applies to each position of the strip's first `rows` rows, rounded up to fours. It must
/// have 0 <= column < width - 1 and 0 <= row < height - 1 in whole pixels. The stride must be at
/// most [`MAX_STRIDE`].
#[target_feature(enable = "avx2")]
pub(super) unsafe fn cut_strip<const GATHERED: bool>(
    sphere: &SphereImage<'_>,
    strip: &Strip,
    rows: usize,
    out: &mut [u8],
    stride: usize,
) {
    let [columns, lines] = strip;
    let (mut u, mut du, ddu) = (load(&columns.value), load(&columns.step), load(&columns.growth));
    let (mut v, mut dv, ddv) = (load(&lines.value), load(&lines.step), load(&lines.growth));

    let upper = sphere.pixels().as_ptr();
    // Offset of two bytes back, which puts the pair of the lower row in the right place for the
    // blend.
    let lower = upper.wrapping_add(sphere.stride() - 2);
    let offsets = offsets(strip, rows, sphere.stride());
    let right_byte = _mm256_setr_epi8(
        1, 1, 1, 1, 5, 5, 5, 5, 9, 9, 9, 9, 13, 13, 13, 13, 1, 1, 1, 1, 5, 5, 5, 5, 9, 9, 9, 9, 13,
        13, 13, 13,
    );
    let down_word = _mm256_setr_epi8(
        0, 1, 0, 1, 4, 5, 4, 5, 8, 9, 8, 9, 12, 13, 12, 13, 0, 1, 0, 1, 4, 5, 4, 5, 8, 9, 8, 9, 12,
        13, 12, 13,
    );
    let left_bytes = _mm256_set1_epi32(0x00ff_00ff);
    let upper_words = _mm256_set1_epi32(0x0000_ffff);
    let weight = _mm256_set1_epi16(ROW_WEIGHT as i16);
    let middle_grey = _mm256_set1_epi8(i8::MIN);
    let rounding = _mm256_set1_epi32((128 << WEIGHT_BITS) + (1 << (WEIGHT_BITS - 1)));

    for first in (0..rows).step_by(4) {
        let mut greys = [_mm256_setzero_si256(); 4];
        for (grey, offsets) in greys.iter_mut().zip(&offsets[first..]) {
            // SAFETY: the caller guarantees that the offset is that of a pixel with a right and a
            // lower neighbour. The upper fetch reads it and the three bytes after it. These end no
            // later than its lower right neighbour, because rows have two pixels or more. The lower
            // fetch reads the lower pair and the two bytes before it.
            let (above, below) =
                unsafe { (fetch::<GATHERED>(upper, offsets), fetch::<GATHERED>(lower, offsets)) };
            let pixels = _mm256_blend_epi16::<0xaa>(above, below);
            let pixels = _mm256_xor_si256(pixels, middle_grey);
            let across = _mm256_xor_si256(_mm256_shuffle_epi8(u, right_byte), left_bytes);
            let pairs = _mm256_maddubs_epi16(across, pixels);
            let down = _mm256_xor_si256(_mm256_shuffle_epi8(v, down_word), upper_words);
            let sums = _mm256_madd_epi16(pairs, _mm256_mulhi_epu16(down, weight));
            *grey = _mm256_srli_epi32::<{ WEIGHT_BITS as i32 }>(_mm256_add_epi32(sums, rounding));
            u = _mm256_add_epi32(u, du);
            v = _mm256_add_epi32(v, dv);
            du = _mm256_add_epi32(du, ddu);
            dv = _mm256_add_epi32(dv, ddv);
        }
        put_four(greys, first, rows, out, stride);
    }
}

/// Like [`cut_strip`], by the cubic. The grey values are those of [`super::sample::sample_cubic`].
///
/// # Safety
/// This applies to each position of the strip's first `rows` rows, rounded up to fours. It must
/// have 1 <= column < width - 2 and 1 <= row < height - 2 in whole pixels. The stride must be at
/// most [`MAX_STRIDE`].
#[target_feature(enable = "avx2")]
pub(super) unsafe fn cut_strip_cubic<const GATHERED: bool>(
    sphere: &SphereImage<'_>,
    strip: &Strip,
    rows: usize,
    out: &mut [u8],
    stride: usize,
) {
    let [columns, lines] = strip;
    let (mut u, mut du, ddu) = (load(&columns.value), load(&columns.step), load(&columns.growth));
    let (mut v, mut dv, ddv) = (load(&lines.value), load(&lines.step), load(&lines.growth));

    let source_stride = sphere.stride();
    // Address of the upper left of the neighbours, for a position at the first pixel.
    let corner = sphere.pixels().as_ptr().wrapping_sub(source_stride + 1);
    let offsets = offsets(strip, rows, source_stride);
    let zero = _mm256_setzero_si256();
    let row_rounding = _mm256_set1_epi32(1 << (cubic::ROW_SHIFT - 1));
    let end_rounding = _mm256_set1_epi32(1 << (cubic::END_SHIFT - 1));
    let low_words = _mm256_set1_epi32(0x0000_ffff);

    for first in (0..rows).step_by(4) {
        let mut greys = [zero; 4];
        for (grey, offsets) in greys.iter_mut().zip(&offsets[first..]) {
            // Weights of columns in the low halves, of rows in the high ones.
            let fractions = _mm256_blend_epi16::<0xaa>(u, _mm256_slli_epi32::<16>(v));
            let [w0, w1, w2, w3] = weights(fractions);
            let across = [
                _mm256_blend_epi16::<0xaa>(w0, _mm256_slli_epi32::<16>(w1)),
                _mm256_blend_epi16::<0xaa>(w2, _mm256_slli_epi32::<16>(w3)),
            ];
            let along = [
                _mm256_blend_epi16::<0xaa>(_mm256_srli_epi32::<16>(w0), w1),
                _mm256_blend_epi16::<0xaa>(_mm256_srli_epi32::<16>(w2), w3),
            ];
            // Four weights for each pixel, in the order in which its row is unpacked.
            let across_low = _mm256_unpacklo_epi32(across[0], across[1]);
            let across_high = _mm256_unpackhi_epi32(across[0], across[1]);
            let mut sums = [zero; 4];
            for (k, sum) in sums.iter_mut().enumerate() {
                let line = corner.wrapping_add(k * source_stride);
                // SAFETY: the caller guarantees that the columns and rows from the position - 1 to
                // the position + 2 lie in the image. This reads four bytes of one of these rows.
                let pixels = unsafe { fetch::<GATHERED>(line, offsets) };
                let low = _mm256_madd_epi16(_mm256_unpacklo_epi8(pixels, zero), across_low);
                let high = _mm256_madd_epi16(_mm256_unpackhi_epi8(pixels, zero), across_high);
                let row = _mm256_add_epi32(_mm256_hadd_epi32(low, high), row_rounding);
                *sum = _mm256_srai_epi32::<{ cubic::ROW_SHIFT as i32 }>(row);
            }
            let pair = |upper: __m256i, lower: __m256i| {
                _mm256_or_si256(_mm256_and_si256(upper, low_words), _mm256_slli_epi32::<16>(lower))
            };
            let upper = _mm256_madd_epi16(pair(sums[0], sums[1]), along[0]);
            let lower = _mm256_madd_epi16(pair(sums[2], sums[3]), along[1]);
            let total = _mm256_add_epi32(_mm256_add_epi32(upper, lower), end_rounding);
            *grey = _mm256_srai_epi32::<{ cubic::END_SHIFT as i32 }>(total);
            u = _mm256_add_epi32(u, du);
            v = _mm256_add_epi32(v, dv);
            du = _mm256_add_epi32(du, ddu);
            dv = _mm256_add_epi32(dv, ddv);
        }
        put_four(greys, first, rows, out, stride);
    }
}

/// [`cubic::weights`] of sixteen fractions of 16 bits.
#[target_feature(enable = "avx2")]
fn weights(fractions: __m256i) -> [__m256i; 4] {
    let t = _mm256_srli_epi16::<1>(fractions);
    let square = _mm256_mulhrs_epi16(t, t);
    let cube = _mm256_mulhrs_epi16(square, t);
    let one = _mm256_set1_epi16(1 << cubic::WEIGHT_BITS);
    let bend = _mm256_sub_epi16(cube, square);
    let first = _mm256_sub_epi16(_mm256_sub_epi16(square, t), bend);
    let first = _mm256_srai_epi16::<2>(first);
    let thrice = _mm256_add_epi16(bend, _mm256_add_epi16(bend, bend));
    let second = _mm256_add_epi16(one, _mm256_srai_epi16::<2>(thrice));
    let second = _mm256_sub_epi16(second, _mm256_srli_epi16::<1>(square));
    let last = _mm256_srai_epi16::<2>(bend);
    let others = _mm256_add_epi16(first, _mm256_add_epi16(second, last));
    [first, second, _mm256_sub_epi16(one, others), last]
}

/// Offsets of the pixels of a strip's rows from the image's first pixel, bytes, for rows rounded up
/// to fours. They are stored in memory all at once, because extracting them from a register one by
/// one would cost more than the loads.
#[target_feature(enable = "avx2")]
fn offsets(strip: &Strip, rows: usize, stride: usize) -> [[i32; LANES]; MAX_ROWS as usize] {
    let [columns, lines] = strip;
    let (mut u, mut du, ddu) = (load(&columns.value), load(&columns.step), load(&columns.growth));
    let (mut v, mut dv, ddv) = (load(&lines.value), load(&lines.step), load(&lines.growth));
    // Low half 1, high half the stride: one multiplication of pairs gives column + row * stride.
    let address = _mm256_set1_epi32(((stride as i32) << 16) | 1);
    let mut offsets = [[0; LANES]; MAX_ROWS as usize];
    for row in offsets.iter_mut().take(rows.next_multiple_of(4)) {
        let whole = _mm256_blend_epi16::<0xaa>(_mm256_srli_epi32::<16>(u), v);
        // SAFETY: eight integers are as long as the vector; unaligned stores are allowed.
        unsafe {
            _mm256_storeu_si256(row.as_mut_ptr().cast(), _mm256_madd_epi16(whole, address));
        }
        u = _mm256_add_epi32(u, du);
        v = _mm256_add_epi32(v, dv);
        du = _mm256_add_epi32(du, ddu);
        dv = _mm256_add_epi32(dv, ddv);
    }
    offsets
}

#[target_feature(enable = "avx2")]
fn load(values: &[i32; LANES]) -> __m256i {
    // SAFETY: eight integers are as long as the vector; unaligned loads are allowed.
    unsafe { _mm256_loadu_si256(values.as_ptr().cast()) }
}

/// Writes four rows of eight grey values, each in a lane of 32 bits, as far as there are rows.
#[target_feature(enable = "avx2")]
fn put_four(greys: [__m256i; 4], first: usize, rows: usize, out: &mut [u8], stride: usize) {
    let rows_in_order = _mm256_setr_epi32(0, 4, 1, 5, 2, 6, 3, 7);
    let [a, b, c, d] = greys;
    // Saturating packs clamp overshoot to 0 and 255.
    let bytes = _mm256_packus_epi16(_mm256_packs_epi32(a, b), _mm256_packs_epi32(c, d));
    let bytes = _mm256_permutevar8x32_epi32(bytes, rows_in_order);
    let lines = [
        _mm256_extract_epi64::<0>(bytes),
        _mm256_extract_epi64::<1>(bytes),
        _mm256_extract_epi64::<2>(bytes),
        _mm256_extract_epi64::<3>(bytes),
    ];
    for (row, line) in (first..rows).zip(lines) {
        put(out, stride, row, line.to_le_bytes());
    }
}
