//! Dark regions that may be markers.

use std::f64::consts::PI;
use std::ops::{Range, RangeInclusive};

use flockeye_geometry::Ray;
use flockeye_geometry::camera::SpherePixel;

use super::bands::Band;
use super::proposal::MarkerSizes;
use super::regions::Region;
use crate::image::LumaImage;
use crate::sphere::SphereImage;

/// Tolerance of a region's longer side below and above the markers' sizes. Blur reduces a marker's
/// border, and a marker seen at an angle is shorter.
const SIZE_TOLERANCE: (f64, f64) = (0.6, 1.5);

/// Least ratio of a region's sides: a marker at 65 degrees has 0.4, and blur reduces it.
const MIN_ASPECT: f64 = 0.3;

/// Least share of its box that a region fills. A square on its corner fills half of its box, and
/// white cells leave holes.
const MIN_FILL: f64 = 0.35;

/// Least difference between each side's surround and the inside, code values.
const MIN_CONTRAST: f32 = 4.0;

/// Share of a square's box with the texture of the cells, to each side of its middle.
const CELLS_SHARE: f64 = 0.35;

/// A dark region that may be a marker.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct DarkSquare {
    pub direction_in_camera: Ray,
    /// Its longer side, radians.
    pub side_rad: f64,
    /// Contrast of the inside with the darkest side of the surround, code values.
    pub contrast: f32,
    /// Difference between the brightest and the darkest side of the surround, as a share of the
    /// contrast.
    pub unevenness: f32,
    /// Standard deviation of the cells' code values.
    pub texture: f32,
    /// Root mean square difference of neighbouring pixels of the cells, code values.
    pub grain: f32,
}

/// The square that a region may be. The region is in `grey`, the image of this band.
#[inline(always)]
pub(super) fn square(
    region: &Region,
    image: &SphereImage<'_>,
    band: &Band,
    grey: &LumaImage<'_>,
    sizes: &MarkerSizes,
) -> Option<DarkSquare> {
    let (width, height) = (region.width(), region.height());
    // Most regions are a few pixels of noise.
    let longest = sizes.most_rad * SIZE_TOLERANCE.1;
    let shortest = sizes.least_rad * SIZE_TOLERANCE.0;
    let height_rad = height as f64 * band.row_rad();
    let is_filled = f64::from(region.area) >= MIN_FILL * (width * height) as f64;
    let (left, right) = (usize::from(region.left), usize::from(region.right));
    if height_rad > longest
        || height_rad < MIN_ASPECT * shortest
        || !is_filled
        || !band.has_whole(left, right)
    {
        return None;
    }
    let (top, bottom) = (usize::from(region.top), usize::from(region.bottom));
    let middle = ((left + right) as f64 / 2.0, (top + bottom) as f64 / 2.0);
    let at = band.in_sphere(middle.0, middle.1);
    let sphere = image.camera();
    let level = (PI * (0.5 - (at.0.y + 0.5) / f64::from(sphere.height()))).cos();
    let width_rad = width as f64 * band.column_rad() * level;
    let (side_rad, shorter) = (height_rad.max(width_rad), height_rad.min(width_rad));
    if side_rad > longest || side_rad < shortest || shorter < MIN_ASPECT * side_rad {
        return None;
    }
    let (contrast, unevenness) = surround(grey, left..=right, top..=bottom)?;
    let (texture, grain) = cells(image, band, at, width, height);
    let direction_in_camera = sphere.ray(at)?;
    Some(DarkSquare { direction_in_camera, side_rad, contrast, unevenness, texture, grain })
}

/// The contrast of a box with its surround, and its unevenness. `None` if a side is too dark.
fn surround(
    grey: &LumaImage<'_>,
    columns: RangeInclusive<usize>,
    rows: RangeInclusive<usize>,
) -> Option<(f32, f32)> {
    let (left, right, top, bottom) = (*columns.start(), *columns.end(), *rows.start(), *rows.end());
    let (width, height) = (right - left + 1, bottom - top + 1);
    // The middle of the quiet zone.
    let gap = (width.max(height) / 8).max(1);
    let is_inside =
        left >= gap && top >= gap && right + gap < grey.width() && bottom + gap < grey.height();
    if !is_inside {
        return None;
    }
    let inside = mean(grey, columns, rows);
    // The middle thirds of the sides.
    let (x, y) = (left + width / 3..=right - width / 3, top + height / 3..=bottom - height / 3);
    let sides = [
        mean(grey, x.clone(), top - gap..=top - gap),
        mean(grey, x, bottom + gap..=bottom + gap),
        mean(grey, left - gap..=left - gap, y.clone()),
        mean(grey, right + gap..=right + gap, y),
    ];
    let darkest = sides.into_iter().fold(f32::MAX, f32::min);
    let brightest = sides.into_iter().fold(0.0, f32::max);
    let is_square = darkest - inside >= MIN_CONTRAST;
    is_square.then(|| (darkest - inside, (brightest - darkest) / (brightest - inside)))
}

fn mean(grey: &LumaImage<'_>, columns: RangeInclusive<usize>, rows: RangeInclusive<usize>) -> f32 {
    let (columns, rows) = (*columns.start()..*columns.end() + 1, *rows.start()..*rows.end() + 1);
    let count = columns.len() * rows.len();
    let mut sum = 0;
    for y in rows {
        for &pixel in &grey.row(y)[columns.clone()] {
            sum += u32::from(pixel);
        }
    }
    sum as f32 / count as f32
}

/// Texture and grain in the middle of a box around `at`, at the picture's own resolution. A reduced
/// marker at 2 m has no visible cells.
fn cells(
    image: &SphereImage<'_>,
    band: &Band,
    at: SpherePixel,
    width: usize,
    height: usize,
) -> (f32, f32) {
    let camera = image.camera();
    let across = band.stretch();
    let SpherePixel(at) = at;
    let place = |middle: f64, side: usize, most: u32| -> Range<usize> {
        let half = CELLS_SHARE * (side * band.factor) as f64;
        let most = most as usize;
        ((middle - half).max(0.0) as usize).min(most - 1)
            ..((middle + half).max(0.0) as usize + 1).min(most)
    };
    let u = at.x.rem_euclid(f64::from(camera.width()));
    let columns = place(u, width * across, camera.width());
    let (mut sum, mut squares, mut count) = (0, 0, 0);
    let (mut steps, mut differences) = (0, 0u32);
    for y in place(at.y, height, camera.height()) {
        let row = &image.pixels()[y * image.stride()..][columns.clone()];
        let mut before = None;
        for &pixel in row.iter().step_by(across) {
            let pixel = u32::from(pixel);
            (sum, squares, count) = (sum + pixel, squares + pixel * pixel, count + 1);
            if let Some(before) = before.replace(pixel) {
                differences += pixel.abs_diff(before).pow(2);
                steps += 1;
            }
        }
    }
    let share = 1.0 / (count.max(1) as f32);
    let variance = squares as f32 * share - (sum as f32 * share).powi(2);
    (variance.max(0.0).sqrt(), (differences as f32 / steps.max(1) as f32).sqrt())
}
