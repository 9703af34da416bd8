//! What is darker than its surroundings.
//!
//! A pixel is dark if it is darker by some code values than the mean of the square round it, as in
//! OpenCV's `adaptiveThreshold`. But the mean of a large square changes little from pixel to pixel: it
//! is had from the means of blocks, which takes a fraction of the time.

use flockeye_imaging::image::LumaImage;

use crate::Threshold;

/// A square is at least so many blocks wide, and less than twice as many: enough to be nearly where it
/// should be, few enough for the sum of their means to fit 16 bits.
const MIN_BLOCKS: usize = 7;

/// Tells what is dark in images; keeps its memory from one to the next.
#[derive(Debug, Default)]
pub struct Darkness {
    blocks: Blocks,
    /// Sum of each column of blocks over the height of a square, and of each square.
    columns: Vec<u16>,
    squares: Vec<u16>,
    /// What pixels of each block, and of each column of the image, must be darker than.
    block_limits: Vec<u8>,
    limits: Vec<u8>,
    dark: Vec<u8>,
}

impl Darkness {
    /// Of each pixel of `image`, row by row, 1 if it is dark and 0 if it is not.
    pub fn of(&mut self, image: &LumaImage<'_>, threshold: Threshold) -> &[u8] {
        let window = threshold.window_px.max(1) as usize;
        let shift = (window / MIN_BLOCKS).max(1).ilog2();
        let side = 1 << shift;
        // The odd number that is nearest.
        let across = window / side / 2 * 2 + 1;
        self.blocks.find(image, side, across / 2);
        let stride = self.blocks.stride;
        let darker_by = threshold.darker_by.round().clamp(0.0, 255.0) as u16;
        let area = (across * across) as u32;
        // Whole numbers of 16 bits: for these compilers know instructions that do eight at once.
        let (reciprocal, half) = (65536 / area + 1, (area / 2) as u16);
        let limit_of = |sum: u16| {
            let mean = ((u32::from(sum + half) * reciprocal) >> 16) as u16;
            (mean + 1).saturating_sub(darker_by).min(255) as u8
        };
        self.dark.clear();
        self.columns.clear();
        self.columns.resize(stride, 0);
        for row in 0..across - 1 {
            add(&mut self.columns, self.blocks.row(row));
        }
        for block_row in 0..image.height().div_ceil(side) {
            add(&mut self.columns, self.blocks.row(block_row + across - 1));
            self.squares.clear();
            self.squares.extend_from_slice(&self.columns[..stride + 1 - across]);
            for next in 1..across {
                for (sum, column) in self.squares.iter_mut().zip(&self.columns[next..]) {
                    *sum += column;
                }
            }
            self.block_limits.clear();
            self.block_limits.extend(self.squares.iter().map(|&sum| limit_of(sum)));
            let limits = match shift {
                0 => &self.block_limits,
                _ => {
                    let column_limits = (0..image.width()).map(|x| self.block_limits[x >> shift]);
                    self.limits.clear();
                    self.limits.extend(column_limits);
                    &self.limits
                }
            };
            for row in block_row * side..image.height().min((block_row + 1) * side) {
                let pixels = image.row(row).iter().zip(limits);
                self.dark.extend(pixels.map(|(pixel, limit)| u8::from(pixel < limit)));
            }
            for (sum, block) in self.columns.iter_mut().zip(self.blocks.row(block_row)) {
                *sum -= u16::from(*block);
            }
        }
        &self.dark
    }
}

/// Means of an image's square blocks, those at its borders repeated beyond them.
#[derive(Debug, Default)]
struct Blocks {
    means: Vec<u8>,
    stride: usize,
    columns: Vec<u32>,
}

impl Blocks {
    fn row(&self, row: usize) -> &[u8] {
        &self.means[row * self.stride..][..self.stride]
    }

    /// Blocks of `side` pixels, and `around` more beyond each border.
    fn find(&mut self, image: &LumaImage<'_>, side: usize, around: usize) {
        self.stride = image.width().div_ceil(side) + 2 * around;
        self.means.clear();
        let rows = image.height().div_ceil(side);
        for block_row in 0..rows {
            let of_image = block_row * side..image.height().min((block_row + 1) * side);
            let start = self.means.len();
            self.means.resize(start + around, 0);
            if side == 1 {
                self.means.extend_from_slice(image.row(block_row));
            } else {
                let high = of_image.len();
                self.columns.clear();
                self.columns.resize(image.width(), 0);
                of_image.for_each(|row| {
                    for (sum, &pixel) in self.columns.iter_mut().zip(image.row(row)) {
                        *sum += u32::from(pixel);
                    }
                });
                let mean =
                    |sums: &[u32]| (sums.iter().sum::<u32>() / (sums.len() * high) as u32) as u8;
                self.means.extend(self.columns.chunks(side).map(mean));
            }
            let (first, last) = (self.means[start + around], self.means[self.means.len() - 1]);
            self.means[start..start + around].fill(first);
            self.means.resize(start + self.stride, last);
            let borders = usize::from(block_row == 0) + usize::from(block_row == rows - 1);
            for _ in 0..borders * around {
                self.means.extend_from_within(self.means.len() - self.stride..);
            }
        }
    }
}

fn add(sums: &mut [u16], row: &[u8]) {
    for (sum, &block) in sums.iter_mut().zip(row) {
        *sum += u16::from(block);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use proptest::prelude::*;

    use super::*;

    /// Mean of the square round a pixel, the outermost ones repeated.
    fn mean(image: &LumaImage<'_>, x: usize, y: usize, window: usize) -> f64 {
        let around = window as i32 / 2;
        let at =
            |at: usize, by: i32, size: usize| (at as i32 + by).clamp(0, size as i32 - 1) as usize;
        let sum: f64 = (-around..=around)
            .flat_map(|dy| (-around..=around).map(move |dx| (dx, dy)))
            .map(|(dx, dy)| {
                let row = image.row(at(y, dy, image.height()));
                f64::from(row[at(x, dx, image.width())])
            })
            .sum();
        sum / (window * window) as f64
    }

    proptest! {
        #[test]
        fn small_windows_are_exact(
            (width, height) in (1usize..40, 1usize..40),
            pixels in prop::collection::vec(any::<u8>(), 40 * 40),
            window in prop::sample::select(vec![3usize, 7, 11, 13]),
            darker_by in prop::sample::select(vec![0.0, 4.0, 10.0]),
        ) {
            let image = LumaImage::new(&pixels, width, height, width).unwrap();
            let mut darkness = Darkness::default();
            let threshold = Threshold { window_px: window as i32, darker_by };
            let dark = darkness.of(&image, threshold);
            prop_assert_eq!(dark.len(), width * height);
            for (index, &dark) in dark.iter().enumerate() {
                let (x, y) = (index % width, index / width);
                let below = mean(&image, x, y, window) - f64::from(pixels[index]);
                // A mean between two codes is rounded.
                if (below - darker_by).abs() > 0.6 {
                    prop_assert_eq!(dark == 1, below > darker_by, "{} {}: {}", x, y, below);
                }
            }
        }

        /// Where light changes slowly, or at random, a mean of blocks is that of pixels.
        #[test]
        fn large_windows_are_nearly_exact(
            (slope, lean) in (-0.4..0.4f64, -0.4..0.4f64),
            noise in prop::collection::vec(0u8..9, 203 * 150),
            window in prop::sample::select(vec![15usize, 31, 61]),
        ) {
            let (width, height) = (203, 150);
            let pixels: Vec<u8> = noise
                .iter()
                .enumerate()
                .map(|(k, &noise)| {
                    let (x, y) = ((k % width) as f64 - 100.0, (k / width) as f64 - 75.0);
                    (120.0 + slope * x + lean * y) as u8 + noise
                })
                .collect();
            let image = LumaImage::new(&pixels, width, height, width).unwrap();
            let mut darkness = Darkness::default();
            let dark = darkness.of(&image, Threshold { window_px: window as i32, darker_by: 2.0 });
            for index in (0..pixels.len()).step_by(37) {
                let (x, y) = (index % width, index / width);
                let edge = x.min(y).min(width - 1 - x).min(height - 1 - y);
                let below = mean(&image, x, y, window) - f64::from(pixels[index]);
                // The middle of a block is up to half a block off.
                let off = 1.5 + 0.8 * (window as f64 / 14.0);
                if edge > window && (below - 2.0).abs() > off {
                    prop_assert_eq!(dark[index] == 1, below > 2.0, "{} {}: {}", x, y, below);
                }
            }
        }
    }

    #[test]
    fn nothing_is_darker_than_itself() {
        for code in [0, 1, 128, 255] {
            let pixels = [code; 50 * 40];
            let image = LumaImage::new(&pixels, 50, 40, 50).unwrap();
            let mut darkness = Darkness::default();
            for window_px in [3, 31, 501] {
                let dark = darkness.of(&image, Threshold { window_px, darker_by: 1.0 });
                assert!(dark.len() == pixels.len() && dark.iter().all(|&dark| dark == 0));
            }
        }
    }
}
