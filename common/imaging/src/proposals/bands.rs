//! The sphere at a lower resolution, in bands of latitude.
//!
//! Near the poles an equirectangular image is stretched along its rows. So bands towards them have
//! a half and a quarter of the columns. Then a pixel is less than twice as wide as it is high, and
//! shapes stay nearly the same, except in the last degrees.

use std::f64::consts::{PI, TAU};
use std::ops::Range;

use flockeye_geometry::camera::SpherePixel;

use crate::sphere::SphereImage;

/// Beginning and end of each band, shares of the height from the upper border, with the power of
/// two by which its columns are reduced further. Bands overlap by 7 degrees or more, so that a body
/// at 1 m is whole in one.
const BANDS: [(f64, f64, u32); 5] =
    [(0.0, 0.11, 2), (0.06, 0.20, 1), (0.14, 0.86, 0), (0.80, 0.94, 1), (0.89, 1.0, 2)];

/// Columns that are repeated behind the last one, so that nothing is cut at the seam.
const SEAM: usize = 64;

/// One band of the reduced image.
#[derive(Debug, Clone)]
pub(super) struct Band {
    rows: Range<usize>,
    /// Columns without the repeated ones.
    columns: usize,
    halvings: u32,
    /// Columns and rows of the sphere image.
    width: usize,
    height: usize,
    /// Columns and rows of the sphere image for each of the reduced image's.
    pub factor: usize,
}

/// The bands of a sphere image reduced to about this many columns at the equator. Images of a few
/// pixels have none.
pub(super) fn bands(width: usize, height: usize, columns: usize) -> impl Iterator<Item = Band> {
    let factor = (width / columns).max(1);
    BANDS.into_iter().filter_map(move |(from, to, halvings)| {
        let at = |share: f64| (share * (height / factor) as f64).round() as usize;
        let columns = (width / factor) >> halvings;
        let band = Band { rows: at(from)..at(to), columns, halvings, width, height, factor };
        (columns > SEAM && band.rows.len() > 1).then_some(band)
    })
}

impl Band {
    /// Whether a region of these columns is neither cut at the seam nor a duplicate.
    pub(super) fn has_whole(&self, left: usize, right: usize) -> bool {
        // A region in the first column continues before the seam, and is whole behind it.
        left > 0 && left <= self.columns && right + 1 < self.columns + SEAM
    }

    /// Factor by which its columns are reduced further than its rows.
    pub(super) fn stretch(&self) -> usize {
        1 << self.halvings
    }

    /// Radians of latitude in a row of the reduced image.
    pub(super) fn row_rad(&self) -> f64 {
        PI / self.height as f64 * self.factor as f64
    }

    /// Radians of longitude in a column.
    pub(super) fn column_rad(&self) -> f64 {
        TAU / self.width as f64 * (self.factor * self.stretch()) as f64
    }

    /// A point of the band in the sphere image.
    pub(super) fn in_sphere(&self, x: f64, y: f64) -> SpherePixel {
        let across = (self.factor * self.stretch()) as f64;
        let down = self.factor as f64;
        let row = y + self.rows.start as f64;
        SpherePixel::new((x + 0.5) * across - 0.5, (row + 0.5) * down - 0.5)
    }

    /// Reduces the band of an image into `out`, and returns the width of the rows there, without
    /// gaps. `rows` are two rows of memory to work in.
    #[inline(always)]
    pub(super) fn reduce(
        &self,
        image: &SphereImage<'_>,
        rows: &mut [Vec<u8>; 2],
        out: &mut Vec<u8>,
    ) -> usize {
        let width = self.columns + SEAM;
        out.resize(width * self.rows.len(), 0);
        let columns = self.width / self.factor;
        let [reduced, halved] = rows;
        reduced.resize(columns, 0);
        halved.resize(columns, 0);
        for (row, out) in self.rows.clone().zip(out.chunks_exact_mut(width)) {
            self.reduce_row(row, image, reduced);
            for _ in 0..self.halvings {
                for (half, pair) in halved.iter_mut().zip(reduced.chunks_exact(2)) {
                    *half = ((u16::from(pair[0]) + u16::from(pair[1])).div_ceil(2)) as u8;
                }
                std::mem::swap(reduced, halved);
            }
            let (own, repeated) = out.split_at_mut(self.columns);
            own.copy_from_slice(&reduced[..self.columns]);
            repeated.copy_from_slice(&reduced[..SEAM]);
        }
        width
    }

    #[inline(always)]
    fn reduce_row(&self, row: usize, image: &SphereImage<'_>, out: &mut [u8]) {
        let source = |k: usize| {
            let first = (row * self.factor + k) * image.stride();
            &image.pixels()[first..first + self.width]
        };
        match self.factor {
            1 => out.copy_from_slice(source(0)),
            2 => {
                // Pairs of bytes as one number, which the compiler adds sixteen at a time.
                let pairs = |k| source(k).as_chunks::<2>().0.iter();
                let sum = |pair: &[u8; 2]| {
                    let both = u16::from_le_bytes(*pair);
                    (both & 0xff) + (both >> 8)
                };
                for (mean, (upper, lower)) in out.iter_mut().zip(pairs(0).zip(pairs(1))) {
                    *mean = ((sum(upper) + sum(lower) + 2) / 4) as u8;
                }
            }
            factor => {
                let area = (factor * factor) as u32;
                for (x, mean) in out.iter_mut().enumerate() {
                    let block = (0..factor).flat_map(|k| &source(k)[x * factor..(x + 1) * factor]);
                    let sum: u32 = block.map(|&pixel| u32::from(pixel)).sum();
                    *mean = ((sum + area / 2) / area) as u8;
                }
            }
        }
    }
}
