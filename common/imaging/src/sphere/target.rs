//! Where the pixels of a view are written.

use super::fixed_point::LANES;

/// The output of a strip of `LANES` columns.
pub(super) struct Target<'a> {
    /// The output from the strip's first pixel on, with rows `stride` bytes apart.
    pub out: &'a mut [u8],
    pub stride: usize,
}

impl Target<'_> {
    /// Writes the strip's row `row`.
    #[inline(always)]
    pub(super) fn put(&mut self, row: usize, greys: [u8; LANES]) {
        let at = row * self.stride;
        self.out[at..at + LANES].copy_from_slice(&greys);
    }
}
