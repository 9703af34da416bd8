//! The panorama behind the bodies for an observer in gusts.
//!
//! It is painted once on the six faces of a cube, which have no poles. Each frame averages it in
//! linear light along the path of each pixel during its exposure. So the backdrop has the camera's
//! motion blur and rolling shutter.

use std::f64::consts::TAU;
use std::num::NonZero;

use nalgebra::{UnitQuaternion, Vector3};

use crate::backdrop::painted;
use crate::moment::Attitude;
use crate::parameters::WorldParameters;
use crate::sensor::ImageSensor;
use crate::sphere::SphereGrid;

/// Stored units per unit of light; the maximum is 3 units of light, at lamps.
const LIGHT_UNITS: f32 = 16_384.0;
/// Values in the table from light to levels.
const LIGHTS: usize = 1 << 16;
/// Side of the blocks in which positions on a face are interpolated, pixels.
const BLOCK: usize = 8;
/// Maximum distance between two samples of a path, pixels, and maximum number of samples.
const LOOK_PX: f64 = 1.5;
const MAX_LOOKS: usize = 8;
/// Fractional bits of a fixed-point position.
const BITS: u32 = 12; // a face of 16,384 texels needs 14 more

#[derive(Debug)]
pub(crate) struct CubeBackdrop {
    /// Texels along the side of a face.
    side: usize,
    /// Faces +x, -x, +y, -y, +z, -z, each with an additional row and column.
    texels: Vec<u16>,
    /// Level and sigma of a light.
    encoded: Vec<[u8; 2]>,
    exposure_s: f64,
    readout_s: f64,
    pixels_per_radian: f64,
}

/// A position on a face: index of the face, and texels from its corner.
#[derive(Debug, Clone, Copy, PartialEq)]
struct CubePlace {
    face: u8,
    at: [f32; 2],
}

impl CubeBackdrop {
    /// Paints the hall with the resolution of the camera's image.
    pub(crate) fn new(parameters: &WorldParameters, sensor: &ImageSensor) -> Self {
        let pixels_per_radian = parameters.camera.pixels_per_radian();
        // The resolution is lowest at the centre of a face.
        let side = ((2.0 * pixels_per_radian).ceil() as usize).max(8);
        let width = ((pixels_per_radian * TAU).round() as usize).max(16) / 2 * 2;
        let grid = SphereGrid::new(width, width / 2);
        let light = painted(parameters, &grid, 0.0);
        let mut texels = Vec::with_capacity(6 * (side + 1) * (side + 1));
        for face in 0..6 {
            for row in 0..=side {
                for column in 0..=side {
                    let at = [column, row].map(|k| 2.0 * k as f64 / side as f64 - 1.0);
                    let value = looked_up(&light, &grid, &direction(face, at)) * LIGHT_UNITS;
                    texels.push(value.clamp(0.0, 65_535.0) as u16);
                }
            }
        }
        let light = |value: usize| value as f32 / LIGHT_UNITS;
        let encoded = (0..LIGHTS)
            .map(|value| [sensor.level(light(value)), sensor.sigma_of_light(light(value))]);
        Self {
            side,
            texels,
            encoded: encoded.collect(),
            exposure_s: parameters.exposure_s,
            readout_s: parameters.readout_s,
            pixels_per_radian,
        }
    }

    /// Writes levels and sigmas of the whole equirectangular image, on all processors.
    pub(crate) fn fill(
        &self,
        grid: &SphereGrid,
        camera: &Attitude,
        levels: &mut [u8],
        sigmas: &mut [u8],
    ) {
        let bands = grid.height.div_ceil(BLOCK);
        let threads = std::thread::available_parallelism().map_or(1, NonZero::get);
        let share = bands.div_ceil(threads);
        let pixels = share * BLOCK * grid.width;
        std::thread::scope(|scope| {
            let shares = levels.chunks_mut(pixels).zip(sigmas.chunks_mut(pixels));
            for (index, (levels, sigmas)) in shares.enumerate() {
                scope.spawn(move || {
                    self.fill_bands(grid, camera, index * share * BLOCK, levels, sigmas);
                });
            }
        });
    }

    /// Writes the bands of [`BLOCK`] rows from `first_row` on.
    fn fill_bands(
        &self,
        grid: &SphereGrid,
        camera: &Attitude,
        first_row: usize,
        levels: &mut [u8],
        sigmas: &mut [u8],
    ) {
        let looks = self.looks(camera);
        let band = BLOCK * grid.width;
        let mut above = self.nodes(grid, camera, first_row);
        let bands = levels.chunks_mut(band).zip(sigmas.chunks_mut(band));
        for (index, (levels, sigmas)) in bands.enumerate() {
            let row = first_row + index * BLOCK;
            let below = self.nodes(grid, camera, row + BLOCK);
            let begin_end = self.begin_end(camera, (row as f64 + 4.0) / grid.height as f64);
            let rows = levels.len() / grid.width;
            for (block, first) in (0..grid.width).step_by(BLOCK).enumerate() {
                let columns = BLOCK.min(grid.width - first);
                let corners = [above[block], above[block + 1], below[block], below[block + 1]];
                let face = corners[0][0].face;
                let is_on_one_face = corners.iter().flatten().all(|place| place.face == face);
                for in_block in 0..rows {
                    let lights = if is_on_one_face {
                        self.along(face, &corners, in_block, looks)
                    } else {
                        std::array::from_fn(|column| {
                            let ray = ray(grid, row + in_block, first + column);
                            self.exactly(&begin_end, &ray, looks)
                        })
                    };
                    let at = in_block * grid.width + first;
                    for (column, light) in lights.into_iter().enumerate().take(columns) {
                        [levels[at + column], sigmas[at + column]] =
                            self.encoded[usize::from(light)];
                    }
                }
            }
            above = below;
        }
    }

    /// Positions of a row's block corners on the cube, at the start and the end of the exposure.
    fn nodes(&self, grid: &SphereGrid, camera: &Attitude, row: usize) -> Vec<[CubePlace; 2]> {
        let begin_end = self.begin_end(camera, row as f64 / grid.height as f64);
        let [begin, end] = begin_end.map(|turn| turn.to_rotation_matrix().into_inner());
        let latitude = (0.5 - (row as f64 + 0.5) / grid.height as f64) * TAU / 2.0;
        let (sin_lat, cos_lat) = latitude.sin_cos();
        let place = |first: usize| {
            // The corner beyond the last column is computed; it is the first column if the blocks
            // fit the width.
            let [cos_lon, sin_lon] = match grid.columns.get(first) {
                Some(column) => column.map(f64::from),
                None => {
                    let over = ray(grid, grid.height / 2, first);
                    [over.x, over.y].map(|k| k / over.x.hypot(over.y))
                }
            };
            let ray = Vector3::new(cos_lat * cos_lon, cos_lat * sin_lon, sin_lat);
            [begin, end].map(|turn| self.place(&(turn * ray)))
        };
        (0..=grid.width.div_ceil(BLOCK)).map(|block| place(block * BLOCK)).collect()
    }

    /// Level and sigma for one ray, in a row at this share of the image's height.
    pub(crate) fn of_ray(&self, camera: &Attitude, ray: &Vector3<f64>, height: f64) -> [u8; 2] {
        let light = self.exactly(&self.begin_end(camera, height), ray, self.looks(camera));
        self.encoded[usize::from(light)]
    }

    /// Orientation of the camera at the start and the end of a row's exposure.
    fn begin_end(&self, camera: &Attitude, height: f64) -> [UnitQuaternion<f64>; 2] {
        let middle_s = (height - 0.5) * self.readout_s;
        [-0.5, 0.5].map(|share| camera.after(middle_s + share * self.exposure_s).world_from_camera)
    }

    /// Number of samples along a pixel's path.
    fn looks(&self, camera: &Attitude) -> usize {
        let way_px = camera.rate_in_camera.norm() * self.exposure_s * self.pixels_per_radian;
        ((way_px / LOOK_PX).ceil() as usize).clamp(1, MAX_LOOKS)
    }

    fn exactly(
        &self,
        [begin, end]: &[UnitQuaternion<f64>; 2],
        ray: &Vector3<f64>,
        looks: usize,
    ) -> u16 {
        let (first, last) = (begin * ray, end * ray);
        let mut sum = 0;
        for look in 0..looks {
            let share = (look as f64 + 0.5) / looks as f64;
            let CubePlace { face, at } = self.place(&first.lerp(&last, share));
            sum += u32::from(self.texel(face, at.map(fixed)));
        }
        (sum / looks as u32) as u16
    }

    /// Mean light along the paths of a block's row on one face. `corners`: top left, top right,
    /// bottom left, bottom right, each at start and end of the exposure.
    #[inline]
    fn along(
        &self,
        face: u8,
        corners: &[[CubePlace; 2]; 4],
        row: usize,
        looks: usize,
    ) -> [u16; BLOCK] {
        let down = row as f32 / BLOCK as f32;
        let side = |above: usize, when: usize, k: usize| {
            let (from, to) = (corners[above][when].at[k], corners[above + 2][when].at[k]);
            from + (to - from) * down
        };
        let mut sums = [0u32; BLOCK];
        for look in 0..looks {
            let share = (look as f32 + 0.5) / looks as f32;
            let then = |above: usize, k: usize| {
                let (begin, end) = (side(above, 0, k), side(above, 1, k));
                begin + (end - begin) * share
            };
            let mut at = [0, 1].map(|k| fixed(then(0, k)));
            let step = [0, 1].map(|k| fixed((then(1, k) - then(0, k)) / BLOCK as f32));
            for sum in &mut sums {
                *sum += u32::from(self.texel(face, at));
                at = [at[0] + step[0], at[1] + step[1]];
            }
        }
        sums.map(|sum| (sum / looks as u32) as u16)
    }

    /// Light at a position, interpolated.
    #[inline]
    fn texel(&self, face: u8, [across, down]: [i32; 2]) -> u16 {
        let most = ((self.side as i32) << BITS) - 1;
        let (across, down) = (across.clamp(0, most), down.clamp(0, most));
        let row_length = self.side + 1;
        let (column, row) = ((across >> BITS) as usize, (down >> BITS) as usize);
        let (s, t) = (across & ((1 << BITS) - 1), down & ((1 << BITS) - 1));
        let at = (usize::from(face) * row_length + row) * row_length + column;
        let mix = |one: i32, other: i32, share: i32| one + (((other - one) * share) >> BITS);
        let pair = |at: usize| mix(i32::from(self.texels[at]), i32::from(self.texels[at + 1]), s);
        mix(pair(at), pair(at + row_length), t) as u16
    }

    fn place(&self, direction: &Vector3<f64>) -> CubePlace {
        let [x, y, z] = [direction.x, direction.y, direction.z];
        let [wide, deep, high] = [x.abs(), y.abs(), z.abs()];
        // Axes as in `direction`.
        let (face, along, [u, v]) = if wide >= deep && wide >= high {
            (usize::from(x < 0.0), wide, [y, z])
        } else if deep >= high {
            (2 + usize::from(y < 0.0), deep, [x, z])
        } else {
            (4 + usize::from(z < 0.0), high, [x, y])
        };
        let at = [u, v].map(|k| ((k / along + 1.0) / 2.0 * self.side as f64) as f32);
        CubePlace { face: face as u8, at }
    }
}

fn fixed(texels: f32) -> i32 {
    (texels * (1 << BITS) as f32) as i32
}

/// Direction of a position on a face, coordinates -1 to 1; not normalized.
fn direction(face: usize, [u, v]: [f64; 2]) -> Vector3<f64> {
    let along = if face.is_multiple_of(2) { 1.0 } else { -1.0 };
    match face / 2 {
        0 => Vector3::new(along, u, v),
        1 => Vector3::new(u, along, v),
        _ => Vector3::new(u, v, along),
    }
}

/// Direction of a pixel of the equirectangular image, also beyond its last row or column.
fn ray(grid: &SphereGrid, row: usize, column: usize) -> Vector3<f64> {
    let longitude = (0.5 - (column as f64 + 0.5) / grid.width as f64) * TAU;
    let latitude = (0.5 - (row as f64 + 0.5) / grid.height as f64) * TAU / 2.0;
    let ((sin_lon, cos_lon), (sin_lat, cos_lat)) = (longitude.sin_cos(), latitude.sin_cos());
    Vector3::new(cos_lat * cos_lon, cos_lat * sin_lon, sin_lat)
}

/// The painted light in a direction, interpolated.
fn looked_up(light: &[f32], grid: &SphereGrid, direction: &Vector3<f64>) -> f32 {
    let (width, height) = (grid.width as f64, grid.height as f64);
    let across = (0.5 - direction.y.atan2(direction.x) / TAU) * width - 0.5;
    let latitude = direction.z.atan2(direction.x.hypot(direction.y));
    let down = ((0.5 - latitude / (TAU / 2.0)) * height - 0.5).clamp(0.0, height - 1.0);
    let (column, row) = (across.floor(), down.floor());
    let (s, t) = ((across - column) as f32, (down - row) as f32);
    let at = |column: f64, row: f64| {
        let column = column.rem_euclid(width) as usize % grid.width;
        light[(row.min(height - 1.0)) as usize * grid.width + column]
    };
    let pair = |row: f64| at(column, row) * (1.0 - s) + at(column + 1.0, row) * s;
    pair(row) * (1.0 - t) + pair(row + 1.0) * t
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockeye_geometry::camera::Camera;

    fn backdrop(change: impl FnOnce(&mut WorldParameters)) -> (CubeBackdrop, SphereGrid) {
        let camera = Camera::equirectangular(512, 256);
        let mut parameters = WorldParameters { camera, iso: 0, ..Default::default() };
        change(&mut parameters);
        let backdrop = CubeBackdrop::new(&parameters, &ImageSensor::new(&parameters));
        (backdrop, SphereGrid::new(512, 256))
    }

    fn picture(backdrop: &CubeBackdrop, grid: &SphereGrid, camera: &Attitude) -> Vec<u8> {
        let mut levels = vec![0; grid.width * grid.height];
        let mut sigmas = levels.clone();
        backdrop.fill(grid, camera, &mut levels, &mut sigmas);
        levels
    }

    #[test]
    fn every_direction_has_its_place() {
        let (cube, grid) = backdrop(|_| ());
        for row in 0..grid.height {
            for column in 0..grid.width {
                let way = ray(&grid, row, column);
                let CubePlace { face, at } = cube.place(&way);
                let at = at.map(|k| 2.0 * f64::from(k) / cube.side as f64 - 1.0);
                assert!(direction(usize::from(face), at).angle(&way) < 1e-5, "{row} {column}");
            }
        }
    }

    #[test]
    fn a_turned_camera_sees_what_the_level_one_sees_elsewhere() {
        let (cube, grid) = backdrop(|_| ());
        let level = picture(&cube, &grid, &Attitude::level(0.0));
        let tilt = UnitQuaternion::from_euler_angles(0.2, -0.15, 1.0);
        let tilted =
            picture(&cube, &grid, &Attitude { world_from_camera: tilt, ..Attitude::level(0.0) });
        let (mut off, mut count) = (0.0, 0.0);
        for row in (20..236).step_by(7) {
            for column in (0..512).step_by(11) {
                let seen = tilt * ray(&grid, row, column);
                let light: Vec<f32> = level.iter().map(|&level| f32::from(level)).collect();
                let expected = looked_up(&light, &grid, &seen);
                off += f64::from((f32::from(tilted[row * 512 + column]) - expected).abs());
                count += 1.0;
            }
        }
        // Interpolated twice, some edges are softer.
        assert!(off / count < 4.0, "{}", off / count);
        assert_ne!(level, tilted);
    }

    #[test]
    fn a_turn_blurs_along_its_way_and_keeps_the_light() {
        let (cube, grid) = backdrop(|p| p.exposure_s = 0.02);
        let still = Attitude::level(0.3);
        let turning = Attitude { rate_in_camera: Vector3::z() * 3.0, ..still };
        let [sharp, blurred] = [still, turning].map(|camera| picture(&cube, &grid, &camera));
        let roughness = |picture: &[u8], step: usize| -> f64 {
            let rows = 100 * 512..160 * 512;
            let pairs = picture[rows.clone()].iter().zip(&picture[rows.start + step..]);
            pairs.map(|(a, b)| f64::from(a.abs_diff(*b))).sum()
        };
        let across = roughness(&blurred, 1) / roughness(&sharp, 1);
        let down = roughness(&blurred, 512) / roughness(&sharp, 512);
        assert!(across < 0.75 && across < 0.8 * down, "{across} {down}");
        let mean = |picture: &[u8]| picture.iter().map(|&x| f64::from(x)).sum::<f64>();
        assert!((mean(&blurred) / mean(&sharp) - 1.0).abs() < 0.01);
    }

    #[test]
    fn rows_are_exposed_one_after_the_other() {
        let (cube, grid) = backdrop(|p| (p.readout_s, p.exposure_s) = (0.03, 0.0));
        let turning = Attitude { rate_in_camera: Vector3::z() * 2.0, ..Attitude::level(0.0) };
        let rolling = picture(&cube, &grid, &turning);
        for (row, height) in [(16usize, 16.0 / 256.0), (200, 200.0 / 256.0)] {
            let then = turning.after((height - 0.5) * 0.03);
            let at_once =
                picture(&cube, &grid, &Attitude { rate_in_camera: Vector3::zeros(), ..then });
            let row = row * 512..(row + 1) * 512;
            assert_eq!(rolling[row.clone()], at_once[row]);
        }
    }
}
