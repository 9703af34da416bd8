//! The panorama behind the bodies: painted once, and shifted by the observer's yaw in each frame.

use std::f64::consts::TAU;
use std::num::NonZero;
use std::sync::Mutex;

use flockeye_runtime::lock::lock;

use crate::hall::Hall;
use crate::kept_painting;
use crate::optics::{blur_kernel, blur_row, blur_rows};
use crate::parameters::WorldParameters;
use crate::sensor::ImageSensor;
use crate::sphere::SphereGrid;

/// Maximum of the blur along a row, columns: it grows towards the poles.
const WIDEST_SIGMA: f64 = 12.0;

/// A panorama in levels and sigmas of the sensor.
#[derive(Debug)]
pub(crate) struct Backdrop {
    width: usize,
    levels: Vec<u8>,
    sigmas: Vec<u8>,
}

impl Backdrop {
    /// Paints the hall, blurred by the lens and by the observer's steady yaw, in linear light.
    pub(crate) fn new(
        parameters: &WorldParameters,
        grid: &SphereGrid,
        sensor: &ImageSensor,
    ) -> Self {
        let light = painted(parameters, grid, parameters.observer_yaw_rate());
        let width = grid.width;
        let encoded = |encode: &(dyn Fn(f32) -> u8 + Sync)| {
            let mut codes = vec![0u8; light.len()];
            for_rows(&mut codes, width, |row, out| {
                let light = &light[row * width..(row + 1) * width];
                out.iter_mut().zip(light).for_each(|(code, &light)| *code = encode(light));
            });
            codes
        };
        Self {
            width,
            levels: encoded(&|light| sensor.level(light)),
            sigmas: encoded(&|light| sensor.sigma_of_light(light)),
        }
    }

    /// Levels and sigmas of a row for an observer turned left by `shift` columns: the first `shift`
    /// columns, and the rest.
    pub(crate) fn row(&self, row: usize, shift: usize) -> [(&[u8], &[u8]); 2] {
        let whole = row * self.width..(row + 1) * self.width;
        let (levels, sigmas) = (&self.levels[whole.clone()], &self.sigmas[whole]);
        let cut = self.width - shift;
        [(&levels[cut..], &sigmas[cut..]), (&levels[..cut], &sigmas[..cut])]
    }
}

/// The hall in linear light on this grid, with lens blur and motion blur. `lens_blur_px` is in
/// pixels of the grid; `yaw_rate` is constant, radians per second.
pub(crate) fn painted(parameters: &WorldParameters, grid: &SphereGrid, yaw_rate: f64) -> Vec<f32> {
    let swept = yaw_rate.abs() * parameters.exposure_s * (grid.width as f64 / TAU);
    let kept = kept_painting::path(parameters, grid, swept);
    let pixels = grid.width * grid.height;
    if let Some(light) = kept.as_ref().and_then(|path| kept_painting::read(path, pixels)) {
        return light;
    }
    let light = freshly_painted(parameters, grid, swept);
    if let Some(path) = kept {
        kept_painting::write(&path, &light);
    }
    light
}

fn freshly_painted(parameters: &WorldParameters, grid: &SphereGrid, swept: f64) -> Vec<f32> {
    let hall = Hall::new(parameters.seed);
    let width = grid.width;
    let mut blurred_along = vec![0.0f32; width * grid.height];
    for_rows(&mut blurred_along, width, |row, out| {
        let sigma = parameters.lens_blur_px / f64::from(grid.rows[row][0]).max(1e-3);
        let kernel = blur_kernel(sigma.min(WIDEST_SIGMA), swept);
        let reach = kernel.len() - 1;
        let sharp: Vec<f32> =
            (0..width).map(|column| pixel_light(&hall, grid, column, row)).collect();
        let padded: Vec<f32> =
            (0..width + 2 * reach).map(|k| sharp[(k + width * reach - reach) % width]).collect();
        blur_row(&padded, out, &kernel, 1);
    });
    let across = blur_kernel(parameters.lens_blur_px, 0.0);
    let mut light = vec![0.0f32; width * grid.height];
    for_rows(&mut light, width, |row, out| {
        blur_rows(&blurred_along, width, row, 0..width, out, &across);
    });
    light
}

/// Mean of two rays per pixel, on a diagonal, a quarter pixel from the centre.
fn pixel_light(hall: &Hall, grid: &SphereGrid, column: usize, row: usize) -> f32 {
    let [cos_lon, sin_lon] = grid.columns[column];
    let [cos_lat, sin_lat] = grid.rows[row];
    // A quarter of a pixel, radians.
    let quarter = std::f32::consts::TAU / grid.width as f32 / 4.0;
    let ray = |turn: f32| {
        let (cos_lon, sin_lon) = (cos_lon - sin_lon * turn, sin_lon + cos_lon * turn);
        let (cos_lat, sin_lat) = (cos_lat - sin_lat * turn, sin_lat + cos_lat * turn);
        hall.light([cos_lat * cos_lon, cos_lat * sin_lon, sin_lat])
    };
    (ray(quarter) + ray(-quarter)) / 2.0
}

/// Calls `fill` for every row, on all processors. Each thread takes the next free row, because the
/// cost per row varies.
pub(crate) fn for_rows<T: Send>(
    rows: &mut [T],
    width: usize,
    fill: impl Fn(usize, &mut [T]) + Sync,
) {
    let threads = std::thread::available_parallelism().map_or(1, NonZero::get);
    let rows = Mutex::new(rows.chunks_mut(width).enumerate());
    // No code panics under this lock, so a poisoned lock is harmless.
    let next = || lock(&rows).next();
    std::thread::scope(|scope| {
        for _ in 0..threads {
            scope.spawn(|| {
                while let Some((row, out)) = next() {
                    fill(row, out);
                }
            });
        }
    });
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::expect_used)]
mod tests {
    use super::*;

    #[test]
    fn turning_left_moves_the_picture_right_and_round() {
        let parameters = WorldParameters::default();
        let grid = SphereGrid::new(256, 128);
        let backdrop = Backdrop::new(&parameters, &grid, &ImageSensor::new(&parameters));
        let row = |shift| {
            let [(a, _), (b, _)] = backdrop.row(60, shift);
            [a, b].concat()
        };
        let (still, turned) = (row(0), row(10));
        assert_eq!(still.len(), 256);
        assert_eq!(turned[10..], still[..246]);
        assert_eq!(turned[..10], still[246..]);
        assert!(still.iter().any(|&level| level != still[0]), "it has texture");
    }
}
