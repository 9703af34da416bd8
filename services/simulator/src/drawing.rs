//! Drawing of a drone on a tangent plane of the sphere: rasterized, blurred there, and composited
//! on the image.
//!
//! The plane has the local scale of the image, so that blur is isotropic in the image. The
//! viewpoint is one eye, along the camera's axes.

use std::f64::consts::PI;
use std::ops::Range;

use nalgebra::{Isometry3, Matrix3, Point2, Point3, Vector3};

use crate::density::{Density, Stretch};
use crate::drone::{DronePart, DroneShape, PaintedFace};
use crate::moment::Placement;
use crate::optics::{blur_kernel, blur_row, blur_rows};
use crate::parameters::WorldParameters;
use crate::raster::{Accumulator, CHANNELS};
use crate::sensor::ImageSensor;
use crate::sphere::SphereGrid;
use crate::sun::Sunlight;
use crate::tiles::RayRow;

/// Variance of the drawing's own blur, square samples: box of one sample (1/12), and linear
/// interpolation (1/6 on average).
const OWN_VARIANCE: f64 = 1.0 / 12.0 + 1.0 / 6.0;
/// Coverage below which a pixel stays unchanged: a hundredth of a grey level.
const FAINT: f32 = 1e-4;

/// The drawing of one drone in one frame. Its buffers are reused in later frames.
#[derive(Debug, Default)]
pub(crate) struct DroneDrawing {
    accumulator: Accumulator,
    width: usize,
    height: usize,
    /// Samples (light, coverage): first as rasterized, then blurred along both axes.
    samples: Vec<f32>,
    /// Samples blurred along the rows.
    half_blurred: Vec<f32>,
    /// Columns that may have content, for each row: all others are empty.
    extents: Vec<Range<usize>>,
    /// Homography from a ray in the camera frame to samples of the plane.
    samples_from_camera: Matrix3<f32>,
    /// Direction to the body: centre of the bounding circle.
    centre: Vector3<f64>,
    longitude: f64,
    latitude: f64,
    /// Radius of the bounding circle, radians.
    radius: f64,
}

/// Illumination of a surface with this normal in the world, as a share of full scale for white.
/// Sources: lamps above, a window at one side, and the walls.
fn illumination(normal_in_world: &Vector3<f64>) -> f64 {
    let lamps = Vector3::new(0.26, 0.17, 0.95);
    let window = Vector3::new(0.0, 1.0, 0.0);
    0.34 + 0.36 * normal_in_world.dot(&lamps).max(0.0)
        + 0.10 * normal_in_world.dot(&window).max(0.0)
}

impl DroneDrawing {
    /// Draws `drone` as seen by an eye, for an image with the density `pixels` there.
    /// `world_from_eye` has the eye's position and the camera's axes.
    ///
    /// The distance must be at least 1.2 radii of the drone, so that all points project on the
    /// plane.
    pub(crate) fn draw(
        &mut self,
        drone: &DroneShape,
        placement: &Placement,
        world_from_eye: &Isometry3<f64>,
        pixels: &Density,
        parameters: &WorldParameters,
    ) {
        let WorldParameters { camera, samples_per_px, lens_blur_px, exposure_s, sun, .. } =
            *parameters;
        let pose = &placement.camera_from_markers;
        let axes = drawing_axes(placement);
        let centre = axes[2];
        let drawing_from_camera = Matrix3::from_columns(&axes).transpose();
        let stretched = |point: &Point3<f64>, stretch: &Stretch| {
            let p = drawing_from_camera * (pose * point).coords;
            let (x, y) = (p.x / p.z, p.y / p.z);
            Point2::new(x * stretch.along + y * stretch.shear, y * stretch.across)
        };
        let bounds = |parts: &[&DronePart], stretch: &Stretch| {
            let corners = parts.iter().flat_map(|part| &part.solid.corners);
            corners
                .map(|corner| stretched(corner, stretch))
                .fold([Point2::new(f64::MAX, f64::MAX), Point2::new(f64::MIN, f64::MIN)], |b, p| {
                    [b[0].inf(&p), b[1].sup(&p)]
                })
        };
        let eye = pose.inverse_transform_point(&Point3::origin());
        let parts = drone.back_to_front(&eye);
        let mut stretch = pixels.stretch([axes[0], axes[1]]).scaled(samples_per_px);
        // Limit of the resolution: the image has no more pixels.
        let widest = samples_per_px * f64::from(camera.width().max(camera.height()));
        let [low, high] = bounds(&parts, &stretch);
        let side = (high - low).max();
        if side > widest {
            // Near the rim of a very wide plane the scale would grow without limit.
            stretch = stretch.scaled(widest / side);
        }

        // The first axis is along the motion, so that motion blur is part of the rows' blur. The
        // root is real: the minimum blur is 0.3 pixels, or 0.6 samples.
        let sigma = ((samples_per_px * lens_blur_px).powi(2) - OWN_VARIANCE).sqrt();
        let motion = placement.angular_speed() * exposure_s * stretch.along;
        let along = blur_kernel(sigma, motion);
        let across = blur_kernel(sigma, 0.0);
        // Twice the reach along the rows: samples within the reach have their own neighbours.
        let margin = Point2::new(2.0 * along.len() as f64 + 1.0, across.len() as f64 + 1.0);
        let [low, high] = bounds(&parts, &stretch);
        let origin = (low - margin.coords).map(f64::floor);
        let size = (high - origin).map(f64::ceil) + margin.coords;
        (self.width, self.height) = (size.x as usize, size.y as usize);
        let reach = parts
            .iter()
            .flat_map(|part| &part.solid.corners)
            .map(|corner| (pose * corner).coords.angle(&centre))
            .fold(0.0, f64::max);
        let aslant = stretch.shear.abs() / stretch.across;
        let wide = (margin.x + margin.y * aslant) / stretch.along;
        self.radius = reach + wide.max(margin.y / stretch.across);
        self.centre = centre;
        self.longitude = centre.y.atan2(centre.x);
        self.latitude = centre.z.atan2(centre.x.hypot(centre.y));
        let samples_from_drawing = Matrix3::new(
            stretch.along,
            stretch.shear,
            -origin.x, //
            0.0,
            stretch.across,
            -origin.y, //
            0.0,
            0.0,
            1.0,
        );
        self.samples_from_camera = (samples_from_drawing * drawing_from_camera).cast();

        let world_from_markers = world_from_eye * pose;
        let sunlight = sun.map(|sun| Sunlight::on(&sun, &world_from_markers));
        self.accumulator.resize(self.width, self.height);
        self.samples.clear();
        self.samples.resize(self.width * self.height * CHANNELS, 0.0);
        self.extents.clear();
        self.extents.resize(self.height, 0..0);
        let place = |point: &Point3<f64>| stretched(point, &stretch) - origin.coords;
        for part in &parts {
            for painted in part.faces.iter().filter(|painted| painted.face.height(&eye) > 0.0) {
                let full = illumination(&(world_from_markers * painted.face.normal));
                add_face(&mut self.accumulator, painted, full, sunlight.as_ref(), place);
            }
            let [low, high] = bounds(&[part], &stretch).map(|corner| corner - origin.coords);
            let rows = low.y as usize..high.y as usize + 1;
            let columns = low.x as usize..high.x as usize + 2;
            for extent in &mut self.extents[rows.clone()] {
                *extent = joined(extent, &columns);
            }
            self.accumulator.lay_over(&mut self.samples, rows, columns, part.opacity);
        }
        self.blur(&along, &across);
    }

    fn blur(&mut self, along: &[f32], across: &[f32]) {
        let row_length = self.width * CHANNELS;
        let reach = along.len() - 1;
        self.half_blurred.clear();
        self.half_blurred.resize(self.samples.len(), 0.0);
        for (row, extent) in self.extents.iter_mut().enumerate() {
            if extent.start == extent.end {
                continue;
            }
            // No underflow: the margins of the drawing are wider than the reach.
            *extent = extent.start - reach..extent.end + reach;
            let padded = extent.start - reach..extent.end + reach;
            let values = |columns: &Range<usize>| {
                row * row_length + columns.start * CHANNELS
                    ..row * row_length + columns.end * CHANNELS
            };
            let out = &mut self.half_blurred[values(extent)];
            blur_row(&self.samples[values(&padded)], out, along, CHANNELS);
        }
        let reach = across.len() - 1;
        for (at, row) in self.samples.chunks_exact_mut(row_length).enumerate() {
            let near = &self.extents[at.saturating_sub(reach)..(at + reach + 1).min(self.height)];
            let extent = near.iter().fold(0..0, |all, extent| joined(&all, extent));
            let values = extent.start * CHANNELS..extent.end * CHANNELS;
            let out = &mut row[values.clone()];
            blur_rows(&self.half_blurred, row_length, at, values, out, across);
        }
    }

    /// Rows of the equirectangular image that the drawing may change.
    pub(crate) fn rows(&self, grid: &SphereGrid) -> Range<usize> {
        grid.rows_of_circle(self.latitude, self.radius)
    }

    /// Whether the drawing may change pixels in the circle of `radius` radians round `axis`.
    pub(crate) fn touches(&self, axis: &Vector3<f64>, radius: f64) -> bool {
        let apart = self.radius + radius;
        apart >= PI || axis.dot(&self.centre) >= apart.cos()
    }

    /// Composites the drawing over pixels with these rays, and updates their noise.
    pub(crate) fn draw_rays(
        &self,
        [rays_x, rays_y, rays_z]: &RayRow,
        sensor: &ImageSensor,
        levels: &mut [u8],
        sigmas: &mut [u8],
    ) {
        let m = &self.samples_from_camera;
        let pixels = levels.iter_mut().zip(sigmas);
        let rays = rays_x.iter().zip(rays_y).zip(rays_z);
        for (((x, y), z), (level, sigma)) in rays.zip(pixels) {
            let along = |k: usize| m[(k, 0)] * x + m[(k, 1)] * y + m[(k, 2)] * z;
            let depth = along(2);
            // Pixels without a ray have depth 0.
            if depth <= 0.0 {
                continue;
            }
            let at = [along(0) / depth, along(1) / depth];
            self.blend(at, sensor, level, sigma);
        }
    }

    /// Composites the drawing over a row of levels and their noise, within `columns`.
    pub(crate) fn draw_row(
        &self,
        row: usize,
        columns: &[Range<usize>],
        grid: &SphereGrid,
        sensor: &ImageSensor,
        levels: &mut [u8],
        sigmas: &mut [u8],
    ) {
        let [cos_row, sin_row] = grid.rows[row];
        let m = &self.samples_from_camera;
        // The ray of a column is (cos lat cos lon, cos lat sin lon, sin lat).
        let [ax, ay, az] = [0, 1, 2].map(|k| m[(k, 0)] * cos_row);
        let [bx, by, bz] = [0, 1, 2].map(|k| m[(k, 1)] * cos_row);
        let [cx, cy, cz] = [0, 1, 2].map(|k| m[(k, 2)] * sin_row);
        let circle = grid.runs_of_circle(row, self.longitude, self.latitude, self.radius);
        let runs = circle.flat_map(|(first, end)| {
            columns.iter().map(move |part| (first.max(part.start), end.min(part.end)))
        });
        for (first, end) in runs.filter(|(first, end)| first < end) {
            let pixels = levels[first..end].iter_mut().zip(&mut sigmas[first..end]);
            for ([cos, sin], (level, sigma)) in grid.columns[first..end].iter().zip(pixels) {
                let depth = az * cos + bz * sin + cz;
                let x = (ax * cos + bx * sin + cx) / depth;
                let y = (ay * cos + by * sin + cy) / depth;
                if depth <= 0.0 {
                    continue;
                }
                self.blend([x, y], sensor, level, sigma);
            }
        }
    }

    /// Composites one point of the drawing over a pixel.
    #[inline]
    fn blend(&self, [x, y]: [f32; 2], sensor: &ImageSensor, level: &mut u8, sigma: &mut u8) {
        if let Some([light, cover]) = self.sample(x, y) {
            *level = sensor.level(sensor.light(*level) * (1.0 - cover) + light);
            *sigma = sensor.sigma(*level);
        }
    }

    /// Light and coverage at a point, interpolated; `None` where the drawing is empty.
    #[inline]
    fn sample(&self, x: f32, y: f32) -> Option<[f32; 2]> {
        // Sample (i, j) is at the centre of its square.
        let (x, y) = (x - 0.5, y - 0.5);
        if !(x >= 0.0 && y >= 0.0) {
            return None;
        }
        let (column, row) = (x as usize, y as usize);
        if column + 1 >= self.width || row + 1 >= self.height {
            return None;
        }
        let (s, t) = (x - column as f32, y - row as f32);
        let at = (row * self.width + column) * CHANNELS;
        let above: &[f32; 4] = self.samples[at..].first_chunk()?;
        let below: &[f32; 4] = self.samples[at + self.width * CHANNELS..].first_chunk()?;
        let mix = |k: usize| {
            let left = above[k] + (below[k] - above[k]) * t;
            let right = above[k + 2] + (below[k + 2] - above[k + 2]) * t;
            left + (right - left) * s
        };
        let cover = mix(1);
        (cover > FAINT).then(|| [mix(0), cover])
    }
}

/// Adds a face and its print. `full` is the illumination of the face; `place` maps points to
/// samples of the drawing.
fn add_face(
    accumulator: &mut Accumulator,
    painted: &PaintedFace,
    full: f64,
    sunlight: Option<&Sunlight>,
    place: impl Fn(&Point3<f64>) -> Point2<f64>,
) {
    let lit = full * sunlight.map_or(1.0, |sunlight| sunlight.shade);
    let added = sunlight.map(|sunlight| (sunlight, full * sunlight.added(&painted.face.normal)));
    let ground = (&painted.face.corners, painted.reflectance, 1.0);
    let prints = painted.print.iter().map(|(corners, change)| (corners, *change, 0.0));
    let mut add = |corners: &[Point3<f64>], light: f64, cover: f64| {
        let outline: Vec<_> = corners.iter().map(&place).collect();
        accumulator.add_polygon(&outline, light, cover);
    };
    for (corners, reflectance, cover) in [ground].into_iter().chain(prints) {
        add(corners, reflectance * lit, cover);
        if let Some((sunlight, added)) = added {
            let reached = sunlight.reaches(corners);
            reached.iter().for_each(|part| add(part, reflectance * added, 0.0));
        }
    }
}

/// The smallest range that contains both; empty ranges are ignored.
fn joined(one: &Range<usize>, other: &Range<usize>) -> Range<usize> {
    match (one.is_empty(), other.is_empty()) {
        (true, _) => other.clone(),
        (_, true) => one.clone(),
        _ => one.start.min(other.start)..one.end.max(other.end),
    }
}

/// Axes of the drawing in the camera frame: x along the apparent motion, z towards the body.
fn drawing_axes(placement: &Placement) -> [Vector3<f64>; 3] {
    let towards = placement.camera_from_markers.translation.vector.normalize();
    let velocity = placement.velocity_in_camera;
    let sideways = velocity - towards * towards.dot(&velocity);
    let along = if sideways.norm() > 1e-9 {
        sideways.normalize()
    } else {
        // Without motion any direction is valid: the axis farthest from the line of sight is used.
        let axis = Vector3::ith(towards.iamin(), 1.0);
        towards.cross(&axis).normalize()
    };
    [along, towards.cross(&along), towards]
}
