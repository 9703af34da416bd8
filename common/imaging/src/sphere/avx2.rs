//! Strips of eight columns at once, by AVX2.

use std::arch::x86_64::*;

use super::SphereImage;
use super::cut::Target;
use super::mapping::LANES;
use super::patch::Strip;
use super::sample::{ROW_WEIGHT, WEIGHT_BITS};

/// Longest stride whose products fit the 16-bit factors of the addresses, bytes.
pub(super) const MAX_STRIDE: usize = i16::MAX as usize;

/// Cuts one strip, whose positions all lie from the image's first column and row to the last but
/// one, into the first `rows` rows of `target`. The same greys as [`super::sample::sample`].
///
/// # Safety
/// Each position of the strip's first `rows` rows, rounded up to fours, must have 0 <= column <
/// width - 1 and 0 <= row < height - 1 in whole pixels, and the stride must be at most
/// [`MAX_STRIDE`].
#[target_feature(enable = "avx2")]
pub(super) unsafe fn cut_strip(
    sphere: &SphereImage<'_>,
    strip: &Strip,
    rows: usize,
    target: &mut Target<'_>,
) {
    let load = |values: &[i32; LANES]| {
        // SAFETY: eight integers are as long as the vector; unaligned loads are allowed.
        unsafe { _mm256_loadu_si256(values.as_ptr().cast()) }
    };
    let [columns, lines] = &strip.series;
    let (mut u, mut du, ddu) = (load(&columns.value), load(&columns.step), load(&columns.growth));
    let (mut v, mut dv, ddv) = (load(&lines.value), load(&lines.step), load(&lines.growth));

    let upper = sphere.pixels().as_ptr();
    // Two bytes early, so that the lower row's pair comes to lie where it is blended in.
    let lower = upper.wrapping_add(sphere.stride() - 2);
    // Low half 1, high half the stride: column + row * stride by one multiplication of pairs.
    let address = _mm256_set1_epi32(((sphere.stride() as i32) << 16) | 1);
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
    let rows_in_order = _mm256_setr_epi32(0, 4, 1, 5, 2, 6, 3, 7);

    for first in (0..rows).step_by(4) {
        let mut greys = [_mm256_setzero_si256(); 4];
        for grey in &mut greys {
            let whole = _mm256_blend_epi16::<0xaa>(_mm256_srli_epi32::<16>(u), v);
            let offset = _mm256_madd_epi16(whole, address);
            // SAFETY: by the caller's word the offset is that of a pixel with a right and a lower
            // neighbour. The upper gather reads it and the three bytes after, which end no later
            // than its lower right neighbour as rows hold two pixels or more; the lower gather
            // reads the lower pair and the two bytes before it.
            let (above, below) = unsafe {
                (
                    _mm256_i32gather_epi32::<1>(upper.cast(), offset),
                    _mm256_i32gather_epi32::<1>(lower.cast(), offset),
                )
            };
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
        let [a, b, c, d] = greys;
        let bytes = _mm256_packus_epi16(_mm256_packus_epi32(a, b), _mm256_packus_epi32(c, d));
        let bytes = _mm256_permutevar8x32_epi32(bytes, rows_in_order);
        let lines = [
            _mm256_extract_epi64::<0>(bytes),
            _mm256_extract_epi64::<1>(bytes),
            _mm256_extract_epi64::<2>(bytes),
            _mm256_extract_epi64::<3>(bytes),
        ];
        for (row, line) in (first..rows).zip(lines) {
            target.put(row, line.to_le_bytes());
        }
    }
}
