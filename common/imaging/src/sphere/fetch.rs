//! Eight loads at once, in the way that is faster on this processor.
//!
//! AVX2's gather instruction is usually the fastest. Microcode against Downfall (CVE-2022-40982)
//! slows it down on Intel's processors from Skylake to Tiger Lake, by a measured factor of ten.
//! There, single loads are faster. A virtual machine hides its processor, so both are timed once in
//! each process.

use std::arch::x86_64::*;
use std::sync::LazyLock;
use std::time::{Duration, Instant};

use super::fixed_point::LANES;

/// Whether gathering is faster than single loads here. The first call measures it, in 20 us.
pub(super) fn gathers() -> bool {
    static GATHERS: LazyLock<bool> = LazyLock::new(|| {
        // SAFETY: this function is called only where the processor has AVX2.
        unsafe { time::<true>() < time::<false>() }
    });
    *GATHERS
}

/// Loads four bytes at each of eight offsets from `base`.
///
/// # Safety
/// The four bytes at each offset must be readable.
#[inline]
#[target_feature(enable = "avx2")]
pub(super) unsafe fn fetch<const GATHERED: bool>(
    base: *const u8,
    offsets: &[i32; LANES],
) -> __m256i {
    if GATHERED {
        // SAFETY: eight integers are as long as the vector; the caller guarantees the rest.
        return unsafe {
            let offsets = _mm256_loadu_si256(offsets.as_ptr().cast());
            _mm256_i32gather_epi32::<1>(base.cast(), offsets)
        };
    }
    // SAFETY: the caller guarantees that these four bytes are readable.
    let at = |k: usize| unsafe { base.offset(offsets[k] as isize).cast::<i32>().read_unaligned() };
    _mm256_setr_epi32(at(0), at(1), at(2), at(3), at(4), at(5), at(6), at(7))
}

/// The shortest time of a few rounds of fetching about 500 numbers.
#[target_feature(enable = "avx2")]
fn time<const GATHERED: bool>() -> Duration {
    const TURNS: usize = 8;
    const FETCHES: usize = 64;
    let bytes = [0u8; 256];
    let offsets: [[i32; LANES]; FETCHES] =
        std::array::from_fn(|row| std::array::from_fn(|k| (3 * row + 7 * k) as i32));
    let mut shortest = Duration::MAX;
    for _ in 0..TURNS {
        let offsets = std::hint::black_box(&offsets);
        let started = Instant::now();
        let mut sum = _mm256_setzero_si256();
        for offsets in offsets {
            // SAFETY: 3 * 63 + 7 * 7 and the three bytes after lie within the 256.
            let fetched = unsafe { fetch::<GATHERED>(bytes.as_ptr(), offsets) };
            sum = _mm256_add_epi32(sum, fetched);
        }
        std::hint::black_box(_mm256_extract_epi32::<0>(sum));
        shortest = shortest.min(started.elapsed());
    }
    shortest
}
