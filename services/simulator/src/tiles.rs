//! Square tiles of any camera's image, with the directions of their pixels.
//!
//! Each tile has a bounding circle on the sphere, so that a drawing can skip most tiles.

use std::f64::consts::PI;

use flockeye_geometry::camera::{Camera, CameraModel, SpherePixel};
use nalgebra::{Matrix2, Matrix2x3, Matrix3x2, Vector3};

use crate::backdrop::for_rows;
use crate::density::Density;
use crate::eyes::Eye;

/// Pixels along a tile's side.
pub(crate) const TILE: usize = 16;

/// Directions of a row of a tile along the camera's axes: x, y and z. All 0 for pixels of other
/// eyes.
pub(crate) type RayRow = [[f32; TILE]; 3];

/// The pixels of one eye in a square of the image.
#[derive(Debug)]
pub(crate) struct ImageTile {
    pub column: usize,
    /// Index of the eye.
    pub eye: usize,
    /// Bit mask of the eye's pixels for each row, the first pixel in the lowest bit.
    pub seen: [u16; TILE],
    /// Directions of the pixels for each row.
    pub rays: [RayRow; TILE],
    /// Centre of the bounding circle of all rays.
    pub axis: Vector3<f64>,
    /// Radius of the bounding circle, radians.
    pub radius: f64,
    /// Pixel density of the image here.
    pub density: Density,
}

impl ImageTile {
    /// Columns of the eye's pixels in row `row` of the tile.
    pub(crate) fn seen_in(&self, row: usize) -> impl Iterator<Item = usize> {
        let seen = self.seen[row];
        (0..TILE).filter(move |column| seen >> column & 1 == 1)
    }
}

/// The tiles of an image, in bands of [`TILE`] rows.
pub(crate) fn bands(camera: &Camera, eyes: &[Eye]) -> Vec<Vec<ImageTile>> {
    let across = (camera.width() as usize).div_ceil(TILE);
    let mut bands: Vec<Vec<ImageTile>> = Vec::new();
    bands.resize_with((camera.height() as usize).div_ceil(TILE), Vec::new);
    for_rows(&mut bands, 1, |index, band| {
        let places = (0..across).flat_map(|k| (0..eyes.len()).map(move |eye| (k, eye)));
        let tiles = places.filter_map(|(k, eye)| tile(camera, eyes, eye, [k * TILE, index * TILE]));
        band[0].extend(tiles);
    });
    bands
}

/// The tile whose first pixel is at `column` and `row`; `None` where the eye has no pixel in it.
fn tile(
    camera: &Camera,
    eyes: &[Eye],
    index: usize,
    [column, row]: [usize; 2],
) -> Option<ImageTile> {
    let eye = &eyes[index];
    let (width, height) = (camera.width() as usize, camera.height() as usize);
    let mut tile = ImageTile {
        column,
        eye: index,
        seen: [0; TILE],
        rays: [[[0.0; TILE]; 3]; TILE],
        axis: Vector3::zeros(),
        radius: 0.0,
        density: Density::Even(camera.pixels_per_radian()),
    };
    // Minimum distance of a pixel from the tile's centre, and that pixel.
    let mut innermost = (f64::INFINITY, SpherePixel::new(0.0, 0.0));
    let mut rays = Vec::with_capacity(TILE * TILE);
    for v in 0..TILE.min(height - row) {
        for u in 0..TILE.min(width - column) {
            let pixel = SpherePixel::new((column + u) as f64, (row + v) as f64);
            let Some(ray) = eye.ray(pixel) else { continue };
            tile.seen[v] |= 1 << u;
            for (axis, value) in ray.iter().enumerate() {
                tile.rays[v][axis][u] = *value as f32;
            }
            rays.push(ray);
            let middle = (TILE as f64 - 1.0) / 2.0;
            let off = (u as f64 - middle).hypot(v as f64 - middle);
            if off < innermost.0 {
                innermost = (off, pixel);
            }
        }
    }
    let sum: Vector3<f64> = rays.iter().map(|ray| ray.into_inner()).sum();
    // Rays in all directions have no mean: any axis is valid, with the whole sphere as circle.
    tile.axis = sum.try_normalize(1e-6).or_else(|| rays.first().map(|ray| ray.into_inner()))?;
    // Tolerance: rays are stored in single precision.
    let reach = rays.iter().map(|ray| ray.angle(&tile.axis)).fold(0.0, f64::max) + 1e-6;
    tile.radius = if sum.norm() < 0.1 { PI } else { reach };
    if !matches!(camera.model(), CameraModel::Equirectangular { .. }) {
        tile.density = local_density(eye, innermost.1).unwrap_or(tile.density);
    }
    Some(tile)
}

/// Pixel density of the image at a pixel; `None` if the eye has no neighbouring pixels.
fn local_density(eye: &Eye, pixel: SpherePixel) -> Option<Density> {
    let slope = |across: f64, down: f64| {
        let at = |step: f64| {
            let ray = eye.ray(SpherePixel::new(pixel.0.x + across * step, pixel.0.y + down * step));
            ray.map(|ray| ray.into_inner())
        };
        // One-sided difference at the border of an image circle.
        match (at(-0.5), at(0.5)) {
            (Some(before), Some(after)) => Some(after - before),
            (Some(before), None) => at(0.0).map(|here| (here - before) * 2.0),
            (None, Some(after)) => at(0.0).map(|here| (after - here) * 2.0),
            (None, None) => None,
        }
    };
    let turn_from_pixels = Matrix3x2::from_columns(&[slope(1.0, 0.0)?, slope(0.0, 1.0)?]);
    let square: Matrix2<f64> = turn_from_pixels.transpose() * turn_from_pixels;
    let pixels_from_turn: Matrix2x3<f64> = square.try_inverse()? * turn_from_pixels.transpose();
    Some(Density::Local(pixels_from_turn))
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::expect_used)]
mod tests {
    use flockeye_geometry::camera::Lens;
    use nalgebra::{Isometry3, UnitQuaternion};

    use super::*;

    /// Equidistant lenses side by side, the second looking back; circles that meet inside a tile.
    fn pair() -> Camera {
        let lens = |turn: f64, u: f64| {
            let ahead = UnitQuaternion::from_euler_angles(0.0, PI / 2.0, turn);
            let pose = Isometry3::from_parts((Vector3::x() * 0.01).into(), ahead);
            Lens::equidistant(pose, [u, 99.5].into(), 99.0, 190f64.to_radians())
        };
        let lenses = [lens(0.0, 99.5), lens(PI, 299.5)];
        Camera::new(400, 200, CameraModel::DualFisheye(lenses)).unwrap()
    }

    fn cameras() -> [Camera; 4] {
        let stitched = CameraModel::Equirectangular { lens_distance_m: 0.016 };
        let plane = CameraModel::Stereographic { field_rad: 320f64.to_radians() };
        [
            pair(),
            Camera::equirectangular(130, 70),
            Camera::new(128, 64, stitched).unwrap(),
            Camera::new(200, 180, plane).unwrap(),
        ]
    }

    #[test]
    fn each_pixel_of_the_camera_is_in_one_tile_with_its_ray() {
        for camera in cameras() {
            let eyes = Eye::all(&camera, None);
            let (width, height) = (camera.width() as usize, camera.height() as usize);
            let mut count = vec![0; width * height];
            for (band, tiles) in bands(&camera, &eyes).iter().enumerate() {
                for tile in tiles {
                    for row in 0..TILE {
                        for column in tile.seen_in(row) {
                            let at = [tile.column + column, band * TILE + row];
                            count[at[1] * width + at[0]] += 1;
                            let ray =
                                Vector3::from_fn(|axis, _| f64::from(tile.rays[row][axis][column]));
                            let pixel = SpherePixel::new(at[0] as f64, at[1] as f64);
                            let expected = camera.ray(pixel).unwrap().into_inner();
                            assert!((ray - expected).norm() < 1e-6);
                            assert!(ray.angle(&tile.axis) <= tile.radius);
                        }
                    }
                }
            }
            for (index, count) in count.into_iter().enumerate() {
                let pixel = SpherePixel::new((index % width) as f64, (index / width) as f64);
                assert_eq!(count, i32::from(camera.ray(pixel).is_some()), "{pixel:?}");
            }
        }
    }

    #[test]
    fn densities_are_those_of_the_projection() {
        for camera in cameras() {
            let eyes = Eye::all(&camera, None);
            for tile in bands(&camera, &eyes).iter().flatten() {
                let (Density::Local(_), Some(pixel)) =
                    (tile.density, eyes[tile.eye].project(&tile.axis))
                else {
                    continue;
                };
                let along = tile.axis.cross(&Vector3::z()).normalize();
                let beside = eyes[tile.eye].project(&(tile.axis + along * 1e-4));
                let Some(beside) = beside else { continue };
                let expected = (beside.0 - pixel.0).norm() / 1e-4;
                let stretch = tile.density.stretch([along, tile.axis.cross(&along)]);
                // Measured at the tile's middle or, where a circle ends, near it.
                assert!((stretch.along / expected - 1.0).abs() < 0.3, "{stretch:?} {expected}");
            }
        }
    }
}
