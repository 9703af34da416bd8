//! Points with texture, and their gradients.

use nalgebra::Vector3;

use super::grid::{COLUMNS, Level, PixelPlace, Sampler};

/// Least number of points at each level of a usable frame.
pub const MIN_POINTS: usize = 60;
/// Side of the blocks, pixels, each with one point, that of the strongest gradient: on the finest
/// level, and on the others.
const BLOCKS: [usize; 2] = [6, 4];
/// Least gradient that stands out from noise and compression, code values per pixel.
const MIN_GRADIENT: f32 = 1.5;
/// Latitude beyond which columns are too narrow, as a sine.
const MAX_SIN_LATITUDE: f32 = 0.97;
/// Lowest latitude of points: 40 degrees under the horizon. Below are the drone's own legs and
/// propellers, and the ground. The ground is nearest, so its parallax pulls the rotation. On a
/// rendered flight in wind this makes the median error 0.030 instead of 0.050 degrees a frame.
const MIN_SIN_LATITUDE: f32 = -0.643;

/// A point of a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TexturePoint {
    /// Its number in the level.
    pub pixel: usize,
    /// Its value.
    pub value: f32,
    /// Its place on the sphere.
    pub place: PixelPlace,
    /// Derivative of the value by the direction, code values per radian, across the direction.
    pub gradient: Vector3<f32>,
}

/// The points of a level that the camera sees.
pub fn points_of(level: &Level, sampler: &Sampler) -> Vec<TexturePoint> {
    const { assert!(COLUMNS.is_multiple_of(BLOCKS[0]) && (COLUMNS / 4).is_multiple_of(BLOCKS[1])) };
    match level.columns {
        COLUMNS => of_blocks::<{ BLOCKS[0] }>(level, sampler),
        _ => of_blocks::<{ BLOCKS[1] }>(level, sampler),
    }
}

fn of_blocks<const BLOCK: usize>(level: &Level, sampler: &Sampler) -> Vec<TexturePoint> {
    let (columns, rows) = (level.columns, level.rows);
    let mut all = Vec::with_capacity(columns * rows / (BLOCK * BLOCK));
    let mut squared = vec![0.0; BLOCK * columns];
    // The strongest of the rows of a block, for each column.
    let mut strongest = vec![0.0f32; columns];
    let sin_latitude =
        |row: usize| ((0.5 - (row as f64 + 0.5) / rows as f64) * std::f64::consts::PI).sin() as f32;
    let is_used = |top: &usize| {
        sin_latitude(*top) >= MIN_SIN_LATITUDE && sin_latitude(top + BLOCK - 1) <= MAX_SIN_LATITUDE
    };
    for top in (1..rows - BLOCK).step_by(BLOCK).filter(is_used) {
        strongest.fill(0.0);
        for (row, squared) in (top..).zip(squared.chunks_exact_mut(columns)) {
            squared_gradients(level, row, squared);
            for (strongest, &squared) in strongest.iter_mut().zip(&*squared) {
                *strongest = strongest.max(squared);
            }
        }
        let (blocks, _) = strongest.as_chunks::<BLOCK>();
        for (left, block) in (0..).step_by(BLOCK).zip(blocks) {
            let best = block.iter().copied().fold(0.0, f32::max);
            if best <= MIN_GRADIENT.powi(2) {
                continue;
            }
            let column = left + block.iter().position(|&squared| squared == best).unwrap_or(0);
            let is_best = |row: &usize| squared[row * columns + column] == best;
            let row = top + (0..BLOCK).find(is_best).unwrap_or(0);
            all.extend(point(level, sampler, row, column));
        }
    }
    all
}

/// The squared gradients of a row's pixels, code values per pixel.
fn squared_gradients(level: &Level, row: usize, squared: &mut [f32]) {
    let columns = level.columns;
    let (above, here, below) = (level.row(row - 1), level.row(row), level.row(row + 1));
    let of = |left: f32, right: f32, column: usize| {
        let (across, down) = (0.5 * (right - left), 0.5 * (below[column] - above[column]));
        across * across + down * down
    };
    squared[0] = of(here[columns - 1], here[1], 0);
    for column in 1..columns - 1 {
        squared[column] = of(here[column - 1], here[column + 1], column);
    }
    squared[columns - 1] = of(here[columns - 2], here[0], columns - 1);
}

fn point(level: &Level, sampler: &Sampler, row: usize, column: usize) -> Option<TexturePoint> {
    let columns = level.columns;
    let pixel = row * columns + column;
    let place = sampler.place(columns, pixel)?;
    let PixelPlace { direction: d, cos_latitude, .. } = place;
    if d.z.abs() > MAX_SIN_LATITUDE || d.z < MIN_SIN_LATITUDE {
        return None;
    }
    let here = level.row(row);
    let left = here[if column == 0 { columns - 1 } else { column - 1 }];
    let right = here[if column + 1 == columns { 0 } else { column + 1 }];
    let across = 0.5 * (right - left);
    let down = 0.5 * (level.row(row + 1)[column] - level.row(row - 1)[column]);
    let per_radian = 1.0 / level.pixel_rad() as f32;
    // Columns run against the longitude, rows against the latitude.
    let east = Vector3::new(-d.y, d.x, 0.0) / cos_latitude;
    let north = d.cross(&east);
    let gradient = (east * (-across / cos_latitude) - north * down) * per_radian;
    Some(TexturePoint { pixel, value: here[column], place, gradient })
}
