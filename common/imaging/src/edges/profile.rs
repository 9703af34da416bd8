//! Radiance across the sides of a marker, with the changes of the print there.

use flockeye_geometry::view::ViewPixel;
use nalgebra::Vector2;

use super::print::{MarkerPrint, QUIET_ZONE_CELLS};
use super::side::SideFrame;
use crate::image::LumaImage;
use crate::light::LinearLight;
use crate::square::{SquareInView, mean_side_px};

/// Assumed blur before the first fit, pixels.
pub(super) const FIRST_BLUR_PX: f64 = 1.2;

/// Distance of samples across a side where the blur is a pixel or less, pixels. With more blur, the
/// steps grow with it.
const STEP_PX: f64 = 0.5;

/// Most profiles of a side.
const MAX_PROFILES: usize = 16;

/// Number of rows of cells that a profile crosses, the border included.
const MAX_DEPTH_CELLS: f64 = 2.5;

/// Least code value that may be clipped, so that its true radiance may be higher.
pub(super) const CLIPPED_CODE: u8 = 254;

/// One sample of a profile.
#[derive(Debug, Clone, Copy)]
pub(super) struct ProfileSample {
    /// Distance from the guessed side, inwards, pixels.
    pub depth: f64,
    pub radiance: f64,
    /// Whether the sample may be clipped.
    pub is_clipped: bool,
}

/// A change of the print along a profile.
#[derive(Debug, Clone, Copy)]
pub(super) struct Change {
    /// Distance from the marker's edge, inwards, pixels.
    pub depth: f64,
    /// Change of the share of white.
    pub white: f64,
}

/// Radiance along one normal of a side.
#[derive(Debug)]
pub(super) struct EdgeProfile {
    /// Position along the side: -1 at the first corner, 1 at the second.
    pub along: f64,
    /// Changes of the print, from the white outside inwards. The first is the edge.
    pub changes: Vec<Change>,
    /// From the outside inwards.
    pub samples: Vec<ProfileSample>,
}

/// All profiles of one side.
#[derive(Debug)]
pub(super) struct Side {
    pub frame: SideFrame,
    /// Distance of samples across the side, pixels.
    pub step: f64,
    /// From the first corner to the second.
    pub profiles: Vec<EdgeProfile>,
}

impl Side {
    /// Samples the side from corner `k` to the next, where the blur is about `blur` pixels. `None`
    /// where fewer than four profiles lie completely in the image.
    pub(super) fn sample(
        image: &LumaImage<'_>,
        light: &LinearLight,
        corners: &[ViewPixel; 4],
        print: &MarkerPrint,
        k: usize,
        blur: [f64; 2],
    ) -> Option<Self> {
        let frame = SideFrame::of(corners, k);
        let SideFrame { along, inward, middle, half } = frame;
        // The square, rotated so that side k is its top.
        let turned = std::array::from_fn(|n| corners[(n + k) % 4]);
        let square = SquareInView::new(&turned)?;
        let cell = mean_side_px(corners) / print.cells() as f64;
        let enough = 3.0 * blur[k % 2] + 1.0;
        let outwards = (QUIET_ZONE_CELLS * cell).clamp(1.0, enough);
        // Near the ends, the quiet zone of the next side ends too.
        let ends = (1.5 * blur[(k + 1) % 2] + 0.5).min(0.5 * half);
        let usable = half - ends;
        let spread = [blur[k % 2].clamp(1.0, 3.0), blur[(k + 1) % 2].clamp(1.0, 3.0)];
        let step = STEP_PX * spread[0];
        let count = ((2.0 * usable / spread[1]).floor() as usize + 1).clamp(6, MAX_PROFILES);
        let profiles: Vec<EdgeProfile> = (0..count)
            .filter_map(|index| {
                let offset = usable * (2.0 * index as f64 / (count - 1) as f64 - 1.0);
                let base = middle + along * offset;
                let changes = changes(&square, print, k, blur[(k + 1) % 2], base, inward)?;
                let deepest = changes.get(1).map_or(cell, |change| change.depth) * MAX_DEPTH_CELLS;
                let inwards = deepest.min(2.0 * enough);
                let steps = ((outwards + inwards) / step).floor() as usize;
                let samples = (0..=steps).map(|index| {
                    let depth = index as f64 * step - outwards;
                    sample(image, light, base, inward, depth)
                });
                Some(EdgeProfile {
                    along: offset / half,
                    changes,
                    samples: samples.collect::<Option<_>>()?,
                })
            })
            .collect();
        (profiles.len() >= 4).then_some(Self { frame, step, profiles })
    }

    /// Depth of the black border at its narrowest, pixels.
    pub(super) fn border(&self) -> f64 {
        let depths = self.profiles.iter().filter_map(|profile| profile.changes.get(1));
        depths.map(|change| change.depth).fold(f64::INFINITY, f64::min)
    }
}

/// Changes of the print along the normal `inward` from `base`, a point of side `k`. `square` is the
/// print, rotated so that this side is its top, and `blur` that along the side, pixels. `None`
/// where the marker is too thin.
fn changes(
    square: &SquareInView,
    print: &MarkerPrint,
    k: usize,
    blur: f64,
    base: Vector2<f64>,
    inward: Vector2<f64>,
) -> Option<Vec<Change>> {
    let cells = print.cells() as f64;
    let mut changes = Vec::with_capacity(5);
    let mut white = 1.0;
    for row in 0..4 {
        let (depth, _) = crossing(square, base, inward, f64::from(row) / cells)?;
        let middle = (f64::from(row) + 0.5) / cells;
        let (_, column) = crossing(square, base, inward, middle)?;
        let blur = blur_along(square, blur, column, middle);
        let share = print.white_share(k, row as isize, column * cells, blur * cells);
        changes.push(Change { depth, white: share - white });
        white = share;
    }
    let rises = changes.windows(2).all(|pair| pair[1].depth - pair[0].depth > 0.3);
    rises.then_some(changes)
}

/// Intersection of the profile with the printed line at `v`: depth in pixels, and u.
fn crossing(
    square: &SquareInView,
    base: Vector2<f64>,
    inward: Vector2<f64>,
    v: f64,
) -> Option<(f64, f64)> {
    let (left, right) = (square.at(0.0, v).0, square.at(1.0, v).0);
    let line = right - left;
    let depth = (left - base).perp(&line) / inward.perp(&line);
    let (u, _) = square.seen_at(ViewPixel(base + inward * depth));
    (depth.is_finite() && u.is_finite()).then_some((depth, u))
}

/// A `blur` in pixels along a printed row at (`u`, `v`), in sides of the marker.
fn blur_along(square: &SquareInView, blur: f64, u: f64, v: f64) -> f64 {
    const STEP: f64 = 0.01;
    let at = |u, v| square.at(u, v).0;
    let along = (at(u + STEP, v) - at(u - STEP, v)) / (2.0 * STEP);
    let down = (at(u, v + STEP) - at(u, v - STEP)).normalize();
    // Perspective crosses slanted columns at an angle.
    blur / along.perp(&down).abs().max(1e-6)
}

/// The sample at `depth` pixels inside `base`.
fn sample(
    image: &LumaImage<'_>,
    light: &LinearLight,
    base: Vector2<f64>,
    inward: Vector2<f64>,
    depth: f64,
) -> Option<ProfileSample> {
    let at = base + inward * depth;
    let value = light.at(image, ViewPixel(at))?;
    // `at` is in the image, because there is a value.
    let (x, y) = (at.x as usize, at.y as usize);
    let right = (x + 1).min(image.width() - 1);
    let is_clipped = [y, (y + 1).min(image.height() - 1)].iter().any(|&y| {
        let row = image.row(y);
        row[x].max(row[right]) >= CLIPPED_CODE
    });
    Some(ProfileSample { depth, radiance: f64::from(value), is_clipped })
}
