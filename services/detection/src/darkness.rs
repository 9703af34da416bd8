//! Pixels that are darker than their surroundings.
//!
//! A pixel is dark if it is darker by some code values, or by some share, than the mean of the
//! square window around it. With code values that is OpenCV's `adaptiveThreshold`. The mean of a
//! large window changes little from pixel to pixel. So it is computed from the means of blocks,
//! which takes a fraction of the time.

use flockeye_imaging::image::LumaImage;

use crate::windows::Threshold;

/// Least blocks along the side of a window that has as many pixels. Decides how far a window may be
/// off its place: half a block. A window has less than twice as many blocks, so that the sum of
/// their means fits 16 bits.
const MIN_BLOCKS: usize = 7;

/// Finds the dark pixels of an image; reuses its memory for the next one.
#[derive(Debug, Default)]
pub(crate) struct Darkness {
    blocks: Blocks,
    /// Sum of each column of blocks over the height of a window, and of each whole window.
    columns: Vec<u16>,
    windows: Vec<u16>,
    /// The code value below which a pixel is dark: one for each column, and one for each two
    /// columns.
    limits: Vec<u8>,
    coarser: Vec<u8>,
    dark: DarkPixels,
}

/// The dark pixels of an image, with a border of one pixel that is not dark.
#[derive(Debug, Default)]
pub(crate) struct DarkPixels {
    /// Every pixel, border included, row by row: 1 for a dark one, 0 for another.
    pub(crate) pixels: Vec<u8>,
    /// Pixels in a row, border included.
    pub(crate) stride: usize,
}

impl DarkPixels {
    /// Starts an image with rows of `width` pixels.
    pub(crate) fn begin(&mut self, width: usize) {
        self.stride = width + 2;
        self.pixels.clear();
        self.pixels.resize(self.stride, 0);
    }

    #[inline(always)]
    pub(crate) fn add(&mut self, row: impl ExactSizeIterator<Item = u8>) {
        let start = self.pixels.len() + 1;
        self.pixels.resize(start + row.len() + 1, 0);
        for (pixel, dark) in self.pixels[start..].iter_mut().zip(row) {
            *pixel = dark;
        }
    }

    /// Adds the border after the last row.
    pub(crate) fn end(&mut self) {
        self.pixels.resize(self.pixels.len() + self.stride, 0);
    }
}

impl Darkness {
    /// Finds the dark pixels of `image`.
    pub(crate) fn of(&mut self, image: &LumaImage<'_>, threshold: Threshold) -> &DarkPixels {
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: the line above has checked that the processor has AVX2.
            unsafe { self.find_avx2(image, threshold) };
            return &self.dark;
        }
        self.find(image, threshold);
        &self.dark
    }

    /// The portable code, compiled for registers of twice as many pixels.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn find_avx2(&mut self, image: &LumaImage<'_>, threshold: Threshold) {
        self.find(image, threshold);
    }

    #[inline(always)]
    fn find(&mut self, image: &LumaImage<'_>, threshold: Threshold) {
        let window = threshold.window_px;
        let shift = (window / MIN_BLOCKS).max(1).ilog2();
        let side = 1 << shift;
        // Odd, so that the window has a block in its middle.
        let across = window / side / 2 * 2 + 1;
        self.blocks.find(image, side, across / 2);
        let stride = self.blocks.stride;
        let area = (across * across) as u32;
        // In integers of 16 bits, of which the compiler divides eight at once by this
        // multiplication. Its result is right to a fifth of a code value.
        let (reciprocal, half) = ((65536 + area / 2) / area, (area / 2) as u16);
        let limit_of = |sum: u16| {
            let mean = ((u32::from(sum + half) * reciprocal) >> 16) as u16;
            threshold.darker_by.limit(mean).min(255) as u8
        };
        self.dark.begin(image.width());
        self.columns.clear();
        self.columns.resize(stride, 0);
        for row in 0..across - 1 {
            add(&mut self.columns, self.blocks.row(row));
        }
        for block_row in 0..image.height().div_ceil(side) {
            add(&mut self.columns, self.blocks.row(block_row + across - 1));
            self.windows.clear();
            self.windows.extend_from_slice(&self.columns[..stride + 1 - across]);
            for next in 1..across {
                for (sum, column) in self.windows.iter_mut().zip(&self.columns[next..]) {
                    *sum += column;
                }
            }
            self.limits.resize(self.windows.len(), 0);
            for (limit, &sum) in self.limits.iter_mut().zip(&self.windows) {
                *limit = limit_of(sum);
            }
            for _ in 0..shift {
                std::mem::swap(&mut self.limits, &mut self.coarser);
                repeat_each(&mut self.limits, &self.coarser);
            }
            for row in block_row * side..image.height().min((block_row + 1) * side) {
                let pixels = image.row(row).iter().zip(&self.limits);
                self.dark.add(pixels.map(|(pixel, limit)| u8::from(pixel < limit)));
            }
            for (sum, block) in self.columns.iter_mut().zip(self.blocks.row(block_row)) {
                *sum -= u16::from(*block);
            }
        }
        self.dark.end();
    }
}

/// Means of an image's square blocks. Those at its borders are repeated beyond them.
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

    /// Computes the means of blocks of `side` pixels, with `around` more blocks beyond each border.
    #[inline(always)]
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
                let mean = |sums: &[u32]| {
                    let count = (sums.len() * high) as u32;
                    ((sums.iter().sum::<u32>() + count / 2) / count) as u8
                };
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

/// Writes each value of `once` twice.
#[inline(always)]
fn repeat_each(twice: &mut Vec<u8>, once: &[u8]) {
    twice.resize(2 * once.len(), 0);
    for (pair, &value) in twice.chunks_exact_mut(2).zip(once) {
        pair[0] = value;
        pair[1] = value;
    }
}

#[inline(always)]
fn add(sums: &mut [u16], row: &[u8]) {
    for (sum, &block) in sums.iter_mut().zip(row) {
        *sum += u16::from(block);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use opencv::core::Mat;
    use opencv::imgproc::{ADAPTIVE_THRESH_MEAN_C, THRESH_BINARY_INV, adaptive_threshold};
    use opencv::prelude::*;
    use proptest::prelude::*;

    use super::*;
    use crate::windows::DarkerBy;

    /// The result for each pixel without the border, row by row: 1 for a dark one.
    fn dark(image: &LumaImage<'_>, window_px: usize, darker_by: u8) -> Vec<u8> {
        let mut darkness = Darkness::default();
        let darker_by = DarkerBy::Codes(darker_by);
        // What is left in memory of another image must not matter.
        darkness
            .of(&LumaImage::new(&[9; 12], 4, 3, 4).unwrap(), Threshold { window_px: 5, darker_by });
        let dark = darkness.of(image, Threshold { window_px, darker_by });
        let rows: Vec<&[u8]> = dark.pixels.chunks_exact(dark.stride).collect();
        let (first, rest) = rows.split_first().unwrap();
        let (last, rows) = rest.split_last().unwrap();
        assert!(first.iter().chain(*last).all(|&dark| dark == 0) && rows.len() == image.height());
        rows.iter()
            .flat_map(|row| {
                assert_eq!((row.len(), row[0], row[row.len() - 1]), (image.width() + 2, 0, 0));
                row[1..row.len() - 1].to_vec()
            })
            .collect()
    }

    /// Mean of the window around a pixel, with the outermost pixels repeated beyond the border.
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
        #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

        #[test]
        fn small_windows_are_exact(
            (width, height) in (1usize..40, 1usize..40),
            pixels in prop::collection::vec(any::<u8>(), 40 * 40),
            window in prop::sample::select(vec![3usize, 5, 7, 9, 11, 13]),
            darker_by in prop::sample::select(vec![1u8, 4, 10]),
        ) {
            let image = LumaImage::new(&pixels, width, height, width).unwrap();
            let dark = dark(&image, window, darker_by);
            for (index, &dark) in dark.iter().enumerate() {
                let (x, y) = (index % width, index / width);
                let below = mean(&image, x, y, window) - f64::from(pixels[index]);
                // Means are rounded to code values, so near the limit either result is right.
                if (below - f64::from(darker_by)).abs() > 0.7 {
                    prop_assert_eq!(dark == 1, below > f64::from(darker_by), "{} {}", x, y);
                }
            }
        }

        /// Dark spots on a slowly changing background: the results agree where spots stand out
        /// clearly.
        #[test]
        fn large_windows_are_those_of_opencv(
            (slope, lean) in (-0.4..0.4f64, -0.4..0.4f64),
            dice in prop::collection::vec((0u8..9, 0u8..10), 203 * 150),
            window_px in prop::sample::select(vec![15usize, 31, 61]),
        ) {
            let (width, height) = (203, 150);
            let pixels: Vec<u8> = dice
                .iter()
                .enumerate()
                .map(|(k, &(noise, dice))| {
                    let (x, y) = ((k % width) as f64 - 100.0, (k / width) as f64 - 75.0);
                    let spot = if dice == 0 { 40 } else { 0 };
                    (140.0 + slope * x + lean * y) as u8 + noise - spot
                })
                .collect();
            let image = LumaImage::new(&pixels, width, height, width).unwrap();
            let dark = dark(&image, window_px, 10);
            let mut theirs = Mat::default();
            adaptive_threshold(
                &Mat::new_rows_cols_with_data(height as i32, width as i32, &pixels).unwrap(),
                &mut theirs,
                1.0,
                ADAPTIVE_THRESH_MEAN_C,
                THRESH_BINARY_INV,
                window_px as i32,
                10.0,
            )
            .unwrap();
            // OpenCV repeats the outermost pixel beyond the border, we repeat the outermost block.
            let inner = |k: &usize| {
                let (x, y, reach) = (k % width, k / width, window_px / 2);
                x.min(y).min(width - 1 - x).min(height - 1 - y) > reach
            };
            for k in (0..pixels.len()).filter(inner) {
                prop_assert_eq!(dark[k], theirs.data_bytes().unwrap()[k]);
                prop_assert_eq!(dark[k] == 1, dice[k].1 == 0);
            }
            prop_assert!((0..pixels.len()).filter(inner).any(|k| dark[k] == 1));
        }
    }

    /// A square of print that the edge of a shadow crosses. White in the shade has 70 code values,
    /// black in the sun 45.
    #[test]
    fn by_a_share_of_the_mean_white_in_the_shade_is_not_dark() {
        let pixels: Vec<u8> = (0..100 * 100)
            .map(|k| {
                let (x, y) = (k % 100, k / 100);
                let is_black = (35..65).contains(&x) && (35..65).contains(&y);
                match (x + y < 100, is_black) {
                    (true, true) => 45,
                    (true, false) => 180,
                    (false, true) => 8,
                    (false, false) => 70,
                }
            })
            .collect();
        let image = LumaImage::new(&pixels, 100, 100, 100).unwrap();
        let mut darkness = Darkness::default();
        let mut wrong = |darker_by| {
            let dark = darkness.of(&image, Threshold { window_px: 31, darker_by });
            // Away from the image's border.
            let inside = (20..80).flat_map(|y| (20..80).map(move |x| (x, y)));
            inside
                .filter(|&(x, y)| {
                    let is_dark = dark.pixels[(y + 1) * dark.stride + x + 1] == 1;
                    let is_black = (35..65).contains(&x) && (35..65).contains(&y);
                    // Deep in the square nothing is brighter around.
                    let is_deep = (40..60).contains(&x) && (40..60).contains(&y);
                    is_dark != is_black && !is_deep
                })
                .count()
        };
        let (by_codes, by_share) = (wrong(DarkerBy::Codes(10)), wrong(DarkerBy::Percent(30)));
        assert!(by_codes > 300 && by_share < 150, "{by_codes}, {by_share}");
    }

    #[test]
    fn uniform_images_have_no_dark_pixels() {
        for code in [0, 1, 128, 255] {
            let pixels = [code; 50 * 40];
            let image = LumaImage::new(&pixels, 50, 40, 50).unwrap();
            for window_px in [3, 31, 501] {
                assert!(dark(&image, window_px, 1).iter().all(|&dark| dark == 0));
            }
        }
    }
}
