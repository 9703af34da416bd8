//! The runs of pixels that are darker than their surroundings.

use std::ops::Range;

use crate::image::LumaImage;

/// Side of the blocks whose means represent the surroundings, pixels of the reduced image.
const BLOCK: usize = 4;

/// Blocks of the surroundings on each side of a pixel's own block. Together they are 20 pixels of
/// the reduced image wide. In a quick search, a marker at 2 m with its quiet zone is half as wide.
const REACH: usize = 2;
const ACROSS: usize = 2 * REACH + 1;

/// Finds runs; reuses its memory.
#[derive(Debug, Default)]
pub(super) struct DarkRuns {
    /// Sum of each block, row by row, with its neighbours of the border repeated outside.
    blocks: Vec<u16>,
    sums: Vec<u16>,
    limits: Vec<u8>,
    row: Vec<u8>,
    /// Columns of each run.
    runs: Vec<Range<u16>>,
}

impl DarkRuns {
    /// Calls `each` with every row's number, and its runs of pixels that are darker by `darker_by`
    /// codes than the mean of their surroundings.
    #[inline(always)]
    pub(super) fn runs(
        &mut self,
        grey: &LumaImage<'_>,
        darker_by: u8,
        mut each: impl FnMut(usize, &[Range<u16>]),
    ) {
        let (width, height) = (grey.width(), grey.height());
        self.sum_blocks(grey);
        let down = height.div_ceil(BLOCK);
        self.limits.resize(width.next_multiple_of(BLOCK), 0);
        self.row.clear();
        // A bright pixel behind the last one ends the last run.
        self.row.resize((width + 1).next_multiple_of(64), 0);
        for block in 0..down {
            self.find_limits(down, block, darker_by);
            for y in block * BLOCK..((block + 1) * BLOCK).min(height) {
                for ((dark, pixel), limit) in self.row.iter_mut().zip(grey.row(y)).zip(&self.limits)
                {
                    *dark = u8::from(pixel < limit);
                }
                collect_runs(&self.row, &mut self.runs);
                each(y, &self.runs);
            }
        }
    }

    #[inline(always)]
    fn sum_blocks(&mut self, grey: &LumaImage<'_>) {
        let (width, height) = (grey.width(), grey.height());
        let (across, down) = (width.div_ceil(BLOCK), height.div_ceil(BLOCK));
        let stride = across + 2 * REACH;
        self.blocks.resize(stride * down, 0);
        for (block, sums) in self.blocks.chunks_exact_mut(stride).enumerate() {
            self.sums.clear();
            self.sums.resize(across * BLOCK, 0);
            for k in 0..BLOCK {
                // The last row and column are repeated outside the image.
                let row = grey.row((block * BLOCK + k).min(height - 1));
                for (sum, &pixel) in self.sums.iter_mut().zip(row) {
                    *sum += u16::from(pixel);
                }
            }
            let last = self.sums[width - 1];
            self.sums[width..].fill(last);
            let inner = &mut sums[REACH..REACH + across];
            for (sum, columns) in inner.iter_mut().zip(self.sums.chunks_exact(BLOCK)) {
                *sum = columns.iter().sum();
            }
            let (first, last) = (inner[0], inner[across - 1]);
            sums[..REACH].fill(first);
            sums[REACH + across..].fill(last);
        }
    }

    /// The code value below which a pixel is dark, for each column of a row of blocks.
    #[inline(always)]
    fn find_limits(&mut self, down: usize, block: usize, darker_by: u8) {
        let stride = self.blocks.len() / down;
        let row = |k: usize| {
            let y = (block + k).saturating_sub(REACH).min(down - 1);
            &self.blocks[y * stride..(y + 1) * stride]
        };
        self.sums.clear();
        self.sums.resize(stride, 0);
        for k in 0..ACROSS {
            for (sum, &block) in self.sums.iter_mut().zip(row(k)) {
                // Five sums of sixteen code values fit 16 bits.
                *sum += block;
            }
        }
        let share = 1.0 / (ACROSS * ACROSS * BLOCK * BLOCK) as f32;
        let less = f32::from(darker_by);
        for (limits, sums) in self.limits.chunks_exact_mut(BLOCK).zip(self.sums.windows(ACROSS)) {
            let sum: u32 = sums.iter().map(|&sum| u32::from(sum)).sum();
            // A negative number becomes 0.
            limits.fill((sum as f32 * share - less) as u8);
        }
    }
}

/// The runs of ones in a row of zeros and ones, of a multiple of 64 ending with 0.
#[inline(always)]
fn collect_runs(row: &[u8], runs: &mut Vec<Range<u16>>) {
    runs.clear();
    let (mut begin, mut last) = (None, 0);
    for (word, pixels) in row.chunks_exact(64).enumerate() {
        let mut bits = 0;
        for (k, pixels) in pixels.as_chunks::<8>().0.iter().enumerate() {
            // The product has the eight lowest bits side by side in its highest byte.
            let packed = u64::from_le_bytes(*pixels).wrapping_mul(0x0102_0408_1020_4080) >> 56;
            bits |= packed << (8 * k);
        }
        // Bits at which a pixel differs from the one before.
        let mut edges = bits ^ (bits << 1 | last);
        last = bits >> 63;
        while edges != 0 {
            let x = (64 * word) as u16 + edges.trailing_zeros() as u16;
            edges &= edges - 1;
            match begin.take() {
                None => begin = Some(x),
                Some(begin) => runs.push(begin..x),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn runs_of(pixels: &[u8], width: usize) -> Vec<(usize, Range<u16>)> {
        let grey = LumaImage::new(pixels, width, pixels.len() / width, width).unwrap();
        let mut found = Vec::new();
        DarkRuns::default()
            .runs(&grey, 5, |y, runs| found.extend(runs.iter().map(|run| (y, run.clone()))));
        found
    }

    #[test]
    fn a_dark_square_has_a_run_in_each_of_its_rows() {
        let (width, height) = (131, 45);
        let mut pixels = vec![200; width * height];
        for y in 10..17 {
            pixels[y * width + 60..y * width + 68].fill(40);
        }
        let expected: Vec<_> = (10..17).map(|y| (y, 60..68)).collect();
        assert_eq!(runs_of(&pixels, width), expected);
    }

    #[test]
    fn runs_reach_to_the_borders() {
        let width = 128;
        let mut pixels = vec![200; width * 9];
        for y in 0..9 {
            pixels[y * width..y * width + 3].fill(0);
            pixels[(y + 1) * width - 2..(y + 1) * width].fill(0);
        }
        let found = runs_of(&pixels, width);
        assert_eq!(found.len(), 18);
        assert_eq!(found[0].1, 0..3);
        assert_eq!(found[1].1, 126..128);
    }

    #[test]
    fn even_pictures_have_none() {
        for code in [0, 1, 4, 128, 255] {
            assert_eq!(runs_of(&[code; 70 * 30], 70), []);
        }
    }
}
