//! The observer's own drone, as its camera sees it: always at the same place, over everything.

use std::f32::consts::{FRAC_PI_2, FRAC_PI_4, TAU};

use crate::density::Density;
use crate::parameters::WorldParameters;
use crate::sensor::ImageSensor;
use crate::sphere::SphereGrid;

/// Latitude of the deck's rim, radians: below it there is nothing else to see.
const DECK_LATITUDE: f32 = -1.2;
/// Latitude up to which the legs reach, radians.
const LEG_TOP: f32 = -0.72;
/// Half the width of a leg, radians.
const LEG_HALF_WIDTH: f32 = 0.028;
/// Legs, evenly spread.
const LEGS: f32 = 4.0;
/// Linear light that the airframe sends back.
const LIGHT: f32 = 0.018;

/// What the own airframe covers in one row.
#[derive(Debug, Default, Clone)]
struct RowCover {
    /// Columns wholly covered, as (first, end).
    runs: Vec<(usize, usize)>,
    /// Columns covered in part, and how much.
    edges: Vec<(usize, f32)>,
}

/// The observer's airframe in its own camera.
#[derive(Debug)]
pub(crate) struct AirframeCover {
    first_row: usize,
    rows: Vec<RowCover>,
    level: u8,
}

/// How much of direction (longitude, latitude; radians) is covered, with edges `softness` wide.
pub(crate) fn cover(longitude: f32, latitude: f32, softness: f32) -> f32 {
    // Angle by which the direction lies outside of the nearest edge; negative inside.
    let deck = latitude - DECK_LATITUDE;
    let sector = TAU / LEGS;
    let turn = (longitude - FRAC_PI_4).rem_euclid(sector);
    let across = turn.min(sector - turn) * latitude.cos() - LEG_HALF_WIDTH;
    let outside = deck.min(across.max(latitude - LEG_TOP));
    (0.5 - outside / softness).clamp(0.0, 1.0)
}

impl AirframeCover {
    /// The airframe on this grid, with edges as soft as a lens of `lens_blur_px` makes them.
    pub(crate) fn new(grid: &SphereGrid, lens_blur_px: f64, sensor: &ImageSensor) -> Self {
        let pixel = TAU / grid.width as f32;
        let softness = edge_softness(lens_blur_px, grid.width as f64);
        let latitude = |row: usize| FRAC_PI_2 - (row as f32 + 0.5) * pixel;
        let longitude = |column: usize| TAU / 2.0 - (column as f32 + 0.5) * pixel;
        let first_row =
            (0..grid.height).find(|&row| latitude(row) < LEG_TOP + softness).unwrap_or(grid.height);
        let rows = (first_row..grid.height)
            .map(|row| {
                let mut covered = RowCover::default();
                for column in 0..grid.width {
                    let cover = cover(longitude(column), latitude(row), softness);
                    if cover >= 1.0 {
                        match covered.runs.last_mut() {
                            Some((_, end)) if *end == column => *end += 1,
                            _ => covered.runs.push((column, column + 1)),
                        }
                    } else if cover > 0.0 {
                        covered.edges.push((column, cover));
                    }
                }
                covered
            })
            .collect();
        Self { first_row, rows, level: sensor.level(LIGHT) }
    }

    pub(crate) fn touches(&self, row: usize) -> bool {
        row >= self.first_row
    }

    /// Draws it over a row of levels and their noise.
    pub(crate) fn draw_row(
        &self,
        row: usize,
        sensor: &ImageSensor,
        levels: &mut [u8],
        sigmas: &mut [u8],
    ) {
        let Some(covered) = row.checked_sub(self.first_row).and_then(|k| self.rows.get(k)) else {
            return;
        };
        for &(first, end) in &covered.runs {
            levels[first..end].fill(self.level);
            sigmas[first..end].fill(sensor.sigma(self.level));
        }
        for &(column, cover) in &covered.edges {
            blend(cover, sensor, &mut levels[column], &mut sigmas[column]);
        }
    }
}

/// Lays the airframe over a pixel of which it covers a share.
pub(crate) fn blend(cover: f32, sensor: &ImageSensor, level: &mut u8, sigma: &mut u8) {
    *level = sensor.level(sensor.light(*level) * (1.0 - cover) + LIGHT * cover);
    *sigma = sensor.sigma(*level);
}

/// Width of a soft edge, radians, in an image of so many pixels to a whole turn: a ramp as wide as
/// four standard deviations looks like the blur.
pub(crate) fn edge_softness(lens_blur_px: f64, pixels_per_turn: f64) -> f32 {
    (4.0 * lens_blur_px) as f32 * TAU / pixels_per_turn as f32
}

/// Width of its soft edges where the image has `density`, radians.
pub(crate) fn softness(parameters: &WorldParameters, density: &Density) -> f32 {
    let pixels_per_turn = density.pixels_per_radian() * std::f64::consts::TAU;
    edge_softness(parameters.lens_blur_px, pixels_per_turn)
}
