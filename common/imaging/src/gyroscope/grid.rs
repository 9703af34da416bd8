//! The sphere as small images of longitude and latitude.

use flockeye_geometry::Ray;
use flockeye_geometry::camera::Camera;
use flockeye_geometry::mask::Mask;
use nalgebra::{Unit, Vector3};

use crate::sphere::SphereImage;

/// Columns of the finest level; it has half as many rows.
pub const COLUMNS: usize = 480;
/// Levels, each half as wide as the one before.
pub const LEVELS: usize = 3;
/// Sampling along either side for a camera that is not equirectangular: camera pixels per pixel of
/// the finest level.
const SAMPLES: usize = 4;
/// Least rows of a block of which only every other row is averaged.
const MANY_ROWS: usize = 8;

/// Lowest averaged latitude, degrees. Points are taken down to 40 degrees below the horizon
/// ([`super::points`]), and turn by less than the rest between two frames.
const LOWEST_DEG: f64 = -65.0;

/// One level: code values by row from the zenith down, as in an equirectangular image.
#[derive(Debug, Clone)]
pub struct Level {
    pub(super) columns: usize,
    pub(super) rows: usize,
    values: Vec<f32>,
}

impl Level {
    fn new(columns: usize, values: Vec<f32>) -> Self {
        Self { columns, rows: columns / 2, values }
    }

    /// The angle between two rows, radians.
    pub fn pixel_rad(&self) -> f64 {
        std::f64::consts::PI / self.rows as f64
    }

    /// The value of a pixel, by its place in rows.
    pub fn at(&self, pixel: usize) -> f32 {
        self.values[pixel]
    }

    /// A row's values.
    pub fn row(&self, row: usize) -> &[f32] {
        &self.values[row * self.columns..(row + 1) * self.columns]
    }

    /// The value at a column (which wraps) and a row, and bilinearly in between.
    pub fn sample(&self, column: f32, row: f32) -> f32 {
        let row = row.clamp(0.0, (self.rows - 1) as f32);
        // From 0 up, so that the conversion rounds down.
        let column = if column < 0.0 { column + self.columns as f32 } else { column };
        let (left, top) = ((column as usize).min(self.columns - 1), row as usize);
        let (x, y) = (column - left as f32, row - top as f32);
        let right = if left + 1 == self.columns { 0 } else { left + 1 };
        let (upper, lower) = (self.row(top), self.row((top + 1).min(self.rows - 1)));
        let upper = upper[left] + (upper[right] - upper[left]) * x;
        let lower = lower[left] + (lower[right] - lower[left]) * x;
        upper + (lower - upper) * y
    }

    /// Half as many columns and rows.
    fn halved(&self) -> Self {
        let columns = self.columns / 2;
        let values = (0..columns * columns / 2)
            .map(|pixel| {
                let (row, column) = (pixel / columns * 2, pixel % columns * 2);
                let of = |row: usize| {
                    let at = row * self.columns + column;
                    self.values[at] + self.values[at + 1]
                };
                0.25 * (of(row) + of(row + 1))
            })
            .collect();
        Self::new(columns, values)
    }
}

/// Direction of a pixel of a level with this many columns.
pub fn direction(columns: usize, pixel: usize) -> Ray {
    let (row, column) = ((pixel / columns) as f64, (pixel % columns) as f64);
    at(columns, column, row)
}

fn at(columns: usize, column: f64, row: f64) -> Ray {
    let columns = columns as f64;
    let longitude = (0.5 - (column + 0.5) / columns) * std::f64::consts::TAU;
    let latitude = (0.5 - (row + 0.5) / (columns / 2.0)) * std::f64::consts::PI;
    let (sin, cos) = latitude.sin_cos();
    Unit::new_unchecked(Vector3::new(cos * longitude.cos(), cos * longitude.sin(), sin))
}

/// Columns of cells, in which points are taken together; half as many rows.
pub const CELL_COLUMNS: usize = 48;
/// All cells.
pub const CELLS: usize = CELL_COLUMNS * CELL_COLUMNS / 2;

/// Place of a pixel on the sphere.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PixelPlace {
    /// Its direction in the camera's frame.
    pub direction: Vector3<f32>,
    /// Cosine of its latitude.
    pub cos_latitude: f32,
    /// The number of its cell.
    pub cell: usize,
}

impl PixelPlace {
    fn of(ray: &Ray) -> Self {
        let share = 0.5 - ray.y.atan2(ray.x) / std::f64::consts::TAU;
        let column = ((share * CELL_COLUMNS as f64) as usize).min(CELL_COLUMNS - 1);
        let rows = CELL_COLUMNS / 2;
        let share = 0.5 - ray.z.clamp(-1.0, 1.0).asin() / std::f64::consts::PI;
        let row = ((share * rows as f64) as usize).min(rows - 1);
        Self {
            direction: ray.cast::<f32>().into_inner(),
            cos_latitude: ray.x.hypot(ray.y) as f32,
            cell: row * CELL_COLUMNS + column,
        }
    }
}

/// Averages frames of one camera to the finest level.
#[derive(Debug, Clone)]
pub struct Sampler {
    /// Side of the camera's blocks that are pixels of the level, if they have whole pixels.
    block: Option<usize>,
    /// Otherwise, columns and rows of the camera's pixels for each pixel of the level.
    table: Vec<[(u32, u32); SAMPLES * SAMPLES]>,
    /// Directions of the pixels of each level; `None` where the camera sees nothing.
    directions: Vec<Vec<Option<PixelPlace>>>,
}

impl Sampler {
    /// Creates the sampler of this camera, without the parts that `mask` hides.
    pub fn new(camera: &Camera, mask: &Mask) -> Self {
        let is_seen = |ray: &Ray| !mask.hides(ray) && camera.project(ray).is_some();
        let of_level = |columns: usize| {
            (0..columns * columns / 2)
                .map(|pixel| Some(direction(columns, pixel)).filter(is_seen))
                .map(|ray| Some(PixelPlace::of(&ray?)))
                .collect()
        };
        let directions = (0..LEVELS).map(|level| of_level(COLUMNS >> level)).collect();
        let width = camera.width() as usize;
        let is_equirectangular = camera.as_equirectangular().is_some();
        if is_equirectangular
            && width.is_multiple_of(COLUMNS)
            && camera.height() as usize * 2 == width
        {
            return Self { block: Some(width / COLUMNS), table: Vec::new(), directions };
        }
        let table = (0..COLUMNS * COLUMNS / 2).map(|pixel| samples(camera, pixel)).collect();
        Self { block: None, table, directions }
    }

    /// Place of a pixel of the level with this many columns. `None` if the camera does not see it.
    pub fn place(&self, columns: usize, pixel: usize) -> Option<PixelPlace> {
        let level = (COLUMNS / columns).trailing_zeros() as usize;
        self.directions.get(level)?.get(pixel).copied().flatten()
    }

    /// A frame at all levels, the finest first.
    pub fn pyramid(&self, frame: &SphereImage<'_>) -> Vec<Level> {
        let finest = match self.block {
            Some(side) => averaged(frame, side),
            None => self.looked_up(frame),
        };
        let mut levels = vec![Level::new(COLUMNS, finest)];
        for _ in 1..LEVELS {
            let next = levels[levels.len() - 1].halved();
            levels.push(next);
        }
        levels
    }

    fn looked_up(&self, frame: &SphereImage<'_>) -> Vec<f32> {
        let (pixels, stride) = (frame.pixels(), frame.stride());
        self.table
            .iter()
            .map(|samples| {
                let of = |&(column, row): &(u32, u32)| {
                    u32::from(pixels[row as usize * stride + column as usize])
                };
                samples.iter().map(of).sum::<u32>() as f32 / (SAMPLES * SAMPLES) as f32
            })
            .collect()
    }
}

/// The camera's pixels that are averaged for one of the level; black ones where it sees nothing.
fn samples(camera: &Camera, pixel: usize) -> [(u32, u32); SAMPLES * SAMPLES] {
    let (row, column) = ((pixel / COLUMNS) as f64, (pixel % COLUMNS) as f64);
    std::array::from_fn(|k| {
        let offset = |k: usize| (k as f64 + 0.5) / SAMPLES as f64 - 0.5;
        let ray = at(COLUMNS, column + offset(k % SAMPLES), row + offset(k / SAMPLES));
        let Some(pixel) = camera.project(&ray) else { return (0, 0) };
        let clamp = |x: f64, side: u32| x.round().clamp(0.0, f64::from(side - 1)) as u32;
        (clamp(pixel.0.x, camera.width()), clamp(pixel.0.y, camera.height()))
    })
}

/// Averages blocks of `side` x `side` pixels, of which every other row is enough where there are
/// many. Rows below [`LOWEST_DEG`] are not read: they repeat the last one above.
fn averaged(frame: &SphereImage<'_>, side: usize) -> Vec<f32> {
    let (pixels, stride) = (frame.pixels(), frame.stride());
    let width = COLUMNS * side;
    let step = if side >= MANY_ROWS { 2 } else { 1 };
    let scale = 1.0 / (side * side.div_ceil(step)) as f32;
    let rows_of = |block: usize| {
        let rows = (block * side..(block + 1) * side).step_by(step);
        rows.map(|row| &pixels[row * stride..row * stride + width])
    };
    let mut values = Vec::with_capacity(COLUMNS * COLUMNS / 2);
    let (rows, read) = (COLUMNS / 2, rows_read());
    if side.is_multiple_of(EIGHT) && side.div_ceil(step) <= MOST_ROWS {
        let mut sums = vec![0u64; width / EIGHT];
        for block in 0..read {
            sums.fill(0);
            rows_of(block).for_each(|row| add_eights(&mut sums, row));
            let of = |sums: &[u64]| sums.iter().map(|&sum| sum_of_lanes(sum)).sum::<u64>() as f32;
            values.extend(sums.chunks_exact(side / EIGHT).map(|sums| of(sums) * scale));
        }
    } else {
        let mut sums = vec![0u16; width];
        for block in 0..read {
            sums.fill(0);
            for row in rows_of(block) {
                for (sum, &value) in sums.iter_mut().zip(row) {
                    *sum += u16::from(value);
                }
            }
            let of = |sums: &[u16]| sums.iter().map(|&sum| u32::from(sum)).sum::<u32>() as f32;
            values.extend(sums.chunks_exact(side).map(|sums| of(sums) * scale));
        }
    }
    for row in read..rows {
        values.extend_from_within((row - 1) * COLUMNS..row * COLUMNS);
    }
    values
}

/// Rows of the finest level that are averaged.
pub(super) fn rows_read() -> usize {
    ((COLUMNS / 2) as f64 * (90.0 - LOWEST_DEG) / 180.0).ceil() as usize
}

/// Pixels that are summed in one word.
const EIGHT: usize = 8;
/// Most rows in a word before a lane, or the sum of the four, exceeds 16 bits.
const MOST_ROWS: usize = 32;
/// Every other byte of a word.
const EVERY_OTHER: u64 = 0x00ff_00ff_00ff_00ff;

/// Adds each eight pixels of a row to a word of four lanes of 16 bits.
fn add_eights(sums: &mut [u64], row: &[u8]) {
    let (eights, _) = row.as_chunks::<EIGHT>();
    for (sum, eight) in sums.iter_mut().zip(eights) {
        let pixels = u64::from_le_bytes(*eight);
        *sum += (pixels & EVERY_OTHER) + ((pixels >> 8) & EVERY_OTHER);
    }
}

/// The sum of the four lanes: multiplied by 1 in each lane, it is in the highest.
fn sum_of_lanes(word: u64) -> u64 {
    word.wrapping_mul(0x0001_0001_0001_0001) >> 48
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn words_of_eight_pixels_give_the_plain_average() {
        for side in [2, 4, 8, 16] {
            let width = (COLUMNS * side) as u32;
            let camera = Camera::equirectangular(width, width / 2);
            let mut state = 1u32;
            let pixels: Vec<u8> = (0..width * width / 2)
                .map(|k| {
                    state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                    // The brightest block must not overflow a lane.
                    if k % width < 2 * side as u32 { 255 } else { (state >> 24) as u8 }
                })
                .collect();
            let frame = SphereImage::new(&pixels, width as usize, camera).unwrap();
            let found = averaged(&frame, side);
            let step = if side >= MANY_ROWS { 2 } else { 1 };
            for (pixel, found) in found.iter().enumerate().take(COLUMNS * COLUMNS / 4) {
                let (row, column) = (pixel / COLUMNS * side, pixel % COLUMNS * side);
                let rows: Vec<usize> = (row..row + side).step_by(step).collect();
                let at = |row: &usize| &pixels[row * width as usize + column..][..side];
                let sum: u32 = rows.iter().flat_map(at).map(|&value| u32::from(value)).sum();
                let wanted = sum as f32 / (rows.len() * side) as f32;
                assert!((found - wanted).abs() < 1e-3, "{found} is not {wanted} at {pixel}");
            }
        }
    }
}
