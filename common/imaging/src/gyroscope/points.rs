//! Points with texture, and their gradients.

use nalgebra::Vector3;

use super::grid::{Level, Place, Sampler};

/// A frame with fewer points at each level says nothing.
pub const MIN_POINTS: usize = 60;
/// One point is taken of each block of so many pixels, the one with the strongest gradient.
const BLOCK: usize = 4;
/// Weaker gradients say nothing beside noise and compression, code values per pixel.
const MIN_GRADIENT: f32 = 1.5;
/// Columns are too narrow beyond this latitude, as a sine.
const MAX_SIN_LATITUDE: f32 = 0.97;
/// Nothing is taken from below 40 degrees under the horizon. There are the drone's own legs and propellers,
/// and the ground, which is nearer than all else: its parallax pulls the rotation. On a rendered flight in
/// wind this makes the median error 0.030 instead of 0.050 degrees a frame.
const MIN_SIN_LATITUDE: f32 = -0.643;

/// A point of a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    /// Its place in the level.
    pub pixel: usize,
    /// Its value.
    pub value: f32,
    /// Its direction in the camera's frame.
    pub direction: Vector3<f32>,
    /// The cell that it is in.
    pub cell: usize,
    /// How the value changes with the direction, code values per radian, across the direction.
    pub gradient: Vector3<f32>,
}

/// The points of a level.
#[derive(Debug, Clone, Default)]
pub struct Points {
    /// All of them.
    pub all: Vec<Point>,
}

impl Points {
    /// The points of a level that the camera sees.
    pub fn of(level: &Level, sampler: &Sampler) -> Self {
        let (columns, rows) = (level.columns(), level.rows());
        let mut all = Vec::with_capacity(columns * rows / (BLOCK * BLOCK));
        let mut squared = vec![0.0; BLOCK * columns];
        for top in (1..rows - BLOCK).step_by(BLOCK) {
            for (row, squared) in (top..).zip(squared.chunks_exact_mut(columns)) {
                squared_gradients(level, row, squared);
            }
            for left in (0..columns + 1 - BLOCK).step_by(BLOCK) {
                let mut best = (MIN_GRADIENT.powi(2), None);
                for row in 0..BLOCK {
                    let start = row * columns + left;
                    for (column, &squared) in (left..).zip(&squared[start..start + BLOCK]) {
                        if squared > best.0 {
                            best = (squared, Some((top + row, column)));
                        }
                    }
                }
                all.extend(best.1.and_then(|(row, column)| point(level, sampler, row, column)));
            }
        }
        Self { all }
    }
}

/// The squared gradients of a row's pixels, code values per pixel.
fn squared_gradients(level: &Level, row: usize, squared: &mut [f32]) {
    let columns = level.columns();
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

fn point(level: &Level, sampler: &Sampler, row: usize, column: usize) -> Option<Point> {
    let columns = level.columns();
    let pixel = row * columns + column;
    let Place { direction: d, cell } = sampler.place(columns, pixel)?;
    if d.z.abs() > MAX_SIN_LATITUDE || d.z < MIN_SIN_LATITUDE {
        return None;
    }
    let here = level.row(row);
    let left = here[if column == 0 { columns - 1 } else { column - 1 }];
    let right = here[if column + 1 == columns { 0 } else { column + 1 }];
    let across = 0.5 * (right - left);
    let down = 0.5 * (level.row(row + 1)[column] - level.row(row - 1)[column]);
    let per_radian = 1.0 / level.pixel_rad() as f32;
    let cos_latitude = d.x.hypot(d.y);
    // Columns count against the longitude, rows against the latitude.
    let east = Vector3::new(-d.y, d.x, 0.0) / cos_latitude;
    let north = d.cross(&east);
    let gradient = (east * (-across / cos_latitude) - north * down) * per_radian;
    Some(Point { pixel, value: here[column], direction: d, cell, gradient })
}
