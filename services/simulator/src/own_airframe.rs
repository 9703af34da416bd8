//! The observer's own airframe in its camera's image: at a fixed place, in front of everything.

use std::f32::consts::{FRAC_PI_2, FRAC_PI_4, TAU};

use crate::density::Density;
use crate::parameters::WorldParameters;
use crate::sensor::ImageSensor;
use crate::sphere::SphereGrid;

/// Latitude of the deck's rim, radians: everything below is covered.
const DECK_LATITUDE: f32 = -1.2;
/// Latitude of the legs' upper end, radians.
const LEG_TOP: f32 = -0.72;
/// Half the width of a leg, radians.
const LEG_HALF_WIDTH: f32 = 0.028;
/// Number of legs, at equal spacing.
const LEGS: f32 = 4.0;
/// Linear light reflected by the airframe.
const LIGHT: f32 = 0.018;

/// The airframe's coverage of an equirectangular image.
#[derive(Debug)]
pub(crate) struct AirframeCover {
    first_row: usize,
    /// Fully covered columns of each row from `first_row` on, as (first, end).
    runs: Vec<Vec<(usize, usize)>>,
    /// Partly covered columns of each row from `first_row` on, and their coverage.
    edges: Vec<Vec<(usize, f32)>>,
    level: u8,
}

/// Coverage of a direction (longitude, latitude; radians), with edges of width `softness`, radians.
pub(crate) fn cover(longitude: f32, latitude: f32, softness: f32) -> f32 {
    // Angle from the nearest edge to the direction; negative inside.
    let deck = latitude - DECK_LATITUDE;
    let sector = TAU / LEGS;
    let turn = (longitude - FRAC_PI_4).rem_euclid(sector);
    let across = turn.min(sector - turn) * latitude.cos() - LEG_HALF_WIDTH;
    let outside = deck.min(across.max(latitude - LEG_TOP));
    (0.5 - outside / softness).clamp(0.0, 1.0)
}

impl AirframeCover {
    /// The airframe on this grid, with edges blurred by `lens_blur_px`.
    pub(crate) fn new(grid: &SphereGrid, lens_blur_px: f64, sensor: &ImageSensor) -> Self {
        let pixel = TAU / grid.width as f32;
        let softness = edge_softness(lens_blur_px, grid.width as f64);
        let latitude = |row: usize| FRAC_PI_2 - (row as f32 + 0.5) * pixel;
        let longitude = |column: usize| TAU / 2.0 - (column as f32 + 0.5) * pixel;
        let first_row =
            (0..grid.height).find(|&row| latitude(row) < LEG_TOP + softness).unwrap_or(grid.height);
        let (runs, edges) = (first_row..grid.height)
            .map(|row| {
                let (mut runs, mut edges) = (Vec::<(usize, usize)>::new(), Vec::new());
                for column in 0..grid.width {
                    let cover = cover(longitude(column), latitude(row), softness);
                    if cover >= 1.0 {
                        match runs.last_mut() {
                            Some((_, end)) if *end == column => *end += 1,
                            _ => runs.push((column, column + 1)),
                        }
                    } else if cover > 0.0 {
                        edges.push((column, cover));
                    }
                }
                (runs, edges)
            })
            .unzip();
        Self { first_row, runs, edges, level: sensor.level(LIGHT) }
    }

    pub(crate) fn touches(&self, row: usize) -> bool {
        row >= self.first_row
    }

    /// Draws the airframe over a row of levels and their noise.
    pub(crate) fn draw_row(
        &self,
        row: usize,
        sensor: &ImageSensor,
        levels: &mut [u8],
        sigmas: &mut [u8],
    ) {
        let Some(row) = row.checked_sub(self.first_row).filter(|&row| row < self.runs.len()) else {
            return;
        };
        for &(first, end) in &self.runs[row] {
            levels[first..end].fill(self.level);
            sigmas[first..end].fill(sensor.sigma(self.level));
        }
        for &(column, cover) in &self.edges[row] {
            blend(cover, sensor, &mut levels[column], &mut sigmas[column]);
        }
    }
}

/// Composites the airframe over a pixel with this coverage.
pub(crate) fn blend(cover: f32, sensor: &ImageSensor, level: &mut u8, sigma: &mut u8) {
    *level = sensor.level(sensor.light(*level) * (1.0 - cover) + LIGHT * cover);
    *sigma = sensor.sigma(*level);
}

/// Width of a soft edge, radians, in an image with `pixels_per_turn` pixels per 360 degrees. A ramp
/// of four standard deviations approximates the blur.
pub(crate) fn edge_softness(lens_blur_px: f64, pixels_per_turn: f64) -> f32 {
    (4.0 * lens_blur_px) as f32 * TAU / pixels_per_turn as f32
}

/// Width of the soft edges where the image has `density`, radians.
pub(crate) fn softness(parameters: &WorldParameters, density: &Density) -> f32 {
    let pixels_per_turn = density.pixels_per_radian() * std::f64::consts::TAU;
    edge_softness(parameters.lens_blur_px, pixels_per_turn)
}
