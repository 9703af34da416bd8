//! Light across the sides of a marker, and what the print says of it.

use flockeye_geometry::view::ViewPixel;
use nalgebra::Vector2;

use super::line::{EdgeLine, cross};
use super::{MarkerPrint, frame_of_side};
use crate::image::LumaImage;
use crate::light::LinearLight;
use crate::square::{SquareInView, mean_side_px};

/// The blur that is assumed before any was measured, pixels.
pub(super) const FIRST_BLUR_PX: f64 = 1.2;

/// Distance of samples across a side, pixels, where the blur is a pixel or less; more blur hides
/// nothing from wider steps.
const STEP_PX: f64 = 0.5;

/// A side is looked at in at most so many places.
const MAX_PROFILES: usize = 16;

/// Rows of cells that a profile goes through, the border included.
const MAX_DEPTH_CELLS: f64 = 2.5;

/// Codes from here on may stand for more light than they say: the camera clips.
pub(super) const CLIPPED_CODE: u8 = 254;

/// One sample of a profile.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sample {
    /// Distance from the side's guess, inwards, pixels.
    pub depth: f64,
    /// The light there.
    pub light: f64,
    /// Whether there may be more of it than the camera could say.
    pub is_clipped: bool,
}

/// A change of the print along a profile.
#[derive(Debug, Clone, Copy)]
pub(super) struct Change {
    /// Distance from the marker's edge, inwards, pixels.
    pub depth: f64,
    /// By how much the share of white rises.
    pub white: f64,
}

/// Light along one normal of a side.
#[derive(Debug)]
pub(super) struct Profile {
    /// Where along the side: -1 at its first corner, 1 at its second.
    pub along: f64,
    /// What the print has there, from the white outside inwards; the first is the edge.
    pub changes: Vec<Change>,
    /// From the outside in.
    pub samples: Vec<Sample>,
}

/// All profiles of one side.
#[derive(Debug)]
pub(super) struct Side {
    /// The guess's middle, in the view.
    pub middle: Vector2<f64>,
    /// Unit vector from the first corner to the second.
    pub along: Vector2<f64>,
    /// Unit vector into the marker.
    pub inward: Vector2<f64>,
    /// Half the guess's length, pixels.
    pub half: f64,
    /// Distance of samples across the side, pixels.
    pub step: f64,
    /// From the first corner to the second.
    pub profiles: Vec<Profile>,
}

impl Side {
    /// Samples the side from corner `k` to the next, where the blur is about `blur` pixels. `None`
    /// where fewer than four profiles lie wholly in the image.
    pub(super) fn sample(
        image: &LumaImage<'_>,
        light: &LinearLight,
        corners: &[ViewPixel; 4],
        print: &MarkerPrint,
        k: usize,
        blur: [f64; 2],
    ) -> Option<Self> {
        let (along, inward, middle, half) = frame_of_side(corners, k);
        // The square turned so that side k is its top.
        let turned = std::array::from_fn(|n| corners[(n + k) % 4]);
        let top = Top { square: SquareInView::new(&turned)?, print, k, blur };
        let cell = mean_side_px(corners) / print.cells() as f64;
        let enough = 3.0 * blur[k % 2] + 1.0;
        let outwards = (print.quiet_zone_cells() * cell).clamp(1.0, enough);
        // Near the ends the next side's quiet zone ends too.
        let ends = (1.5 * blur[(k + 1) % 2] + 0.5).min(0.5 * half);
        let usable = half - ends;
        let spread = [blur[k % 2].clamp(1.0, 3.0), blur[(k + 1) % 2].clamp(1.0, 3.0)];
        let step = STEP_PX * spread[0];
        let count = ((2.0 * usable / spread[1]).floor() as usize + 1).clamp(6, MAX_PROFILES);
        let profiles: Vec<Profile> = (0..count)
            .filter_map(|index| {
                let offset = usable * (2.0 * index as f64 / (count - 1) as f64 - 1.0);
                let base = middle + along * offset;
                let changes = top.changes(base, inward)?;
                let deepest = changes.get(1).map_or(cell, |change| change.depth) * MAX_DEPTH_CELLS;
                let inwards = deepest.min(2.0 * enough);
                let steps = ((outwards + inwards) / step).floor() as usize;
                let samples = (0..=steps).map(|index| {
                    let depth = index as f64 * step - outwards;
                    sample(image, light, base, inward, depth)
                });
                Some(Profile {
                    along: offset / half,
                    changes,
                    samples: samples.collect::<Option<_>>()?,
                })
            })
            .collect();
        (profiles.len() >= 4).then_some(Self { middle, along, inward, half, step, profiles })
    }

    /// Depth of the black border, where it is narrowest, pixels.
    pub(super) fn border(&self) -> f64 {
        let depths = self.profiles.iter().filter_map(|profile| profile.changes.get(1));
        depths.map(|change| change.depth).fold(f64::INFINITY, f64::min)
    }
}

/// The print with one of its sides as the top.
struct Top<'a> {
    square: SquareInView,
    print: &'a MarkerPrint,
    k: usize,
    blur: [f64; 2],
}

impl Top<'_> {
    /// What the print has along the normal `inward` from `base`, a point of the side. `None` where
    /// the marker is too thin to say.
    fn changes(&self, base: Vector2<f64>, inward: Vector2<f64>) -> Option<Vec<Change>> {
        let cells = self.print.cells() as f64;
        let mut changes = Vec::with_capacity(5);
        let mut white = 1.0;
        for row in 0..4 {
            let (depth, _) = self.crossing(base, inward, f64::from(row) / cells)?;
            let (_, column) = self.crossing(base, inward, (f64::from(row) + 0.5) / cells)?;
            let blur = self.blur_along(column, (f64::from(row) + 0.5) / cells);
            let share = self.print.white_share(self.k, row as isize, column * cells, blur * cells);
            changes.push(Change { depth, white: share - white });
            white = share;
        }
        let rises = changes.windows(2).all(|pair| pair[1].depth - pair[0].depth > 0.3);
        rises.then_some(changes)
    }

    /// Where the profile meets the printed line at `v`: depth in pixels, and u.
    fn crossing(&self, base: Vector2<f64>, inward: Vector2<f64>, v: f64) -> Option<(f64, f64)> {
        let (left, right) = (self.square.at(0.0, v).0, self.square.at(1.0, v).0);
        let line = right - left;
        let depth = (left - base).perp(&line) / inward.perp(&line);
        let (u, _) = self.square.seen_at(ViewPixel(base + inward * depth));
        (depth.is_finite() && u.is_finite()).then_some((depth, u))
    }

    /// The blur along a printed row at (`u`, `v`), in sides of the marker.
    fn blur_along(&self, u: f64, v: f64) -> f64 {
        const STEP: f64 = 0.01;
        let at = |u, v| self.square.at(u, v).0;
        let along = (at(u + STEP, v) - at(u - STEP, v)) / (2.0 * STEP);
        let down = (at(u, v + STEP) - at(u, v - STEP)).normalize();
        // Columns that lean are crossed at an angle.
        self.blur[(self.k + 1) % 2] / along.perp(&down).abs().max(1e-6)
    }
}

/// The light at `depth` pixels inside `base`.
fn sample(
    image: &LumaImage<'_>,
    light: &LinearLight,
    base: Vector2<f64>,
    inward: Vector2<f64>,
    depth: f64,
) -> Option<Sample> {
    let at = base + inward * depth;
    let value = light.at(image, ViewPixel(at))?;
    // `at` is in the image, or there would be no value.
    let (x, y) = (at.x as usize, at.y as usize);
    let right = (x + 1).min(image.width() - 1);
    let is_clipped = [y, (y + 1).min(image.height() - 1)].iter().any(|&y| {
        let row = image.row(y);
        row[x].max(row[right]) >= CLIPPED_CODE
    });
    Some(Sample { depth, light: f64::from(value), is_clipped })
}

/// Moves each side to where the mean profile falls most steeply: a guess that is off by up to two
/// pixels comes within the reach of the fit, and the border's *inner* edge, which rises, cannot be
/// taken for the outer one.
pub(super) fn approach(
    image: &LumaImage<'_>,
    light: &LinearLight,
    guess: &[ViewPixel; 4],
    cells: usize,
) -> Option<[ViewPixel; 4]> {
    const SEARCH_PX: f64 = 2.0;
    const STEP: f64 = 0.25;
    let cell = mean_side_px(guess) / cells as f64;
    let window = (0.5 * cell).clamp(1.0, 3.0);
    let width = (window / STEP).round() as usize;
    let search = (SEARCH_PX / STEP) as usize;
    // Light at each step of depth, from `search + width` steps outside the guess to as many inside.
    let mut values = vec![0.0f32; 2 * (search + width) + 1];
    let mut moved = Vec::with_capacity(4);
    for k in 0..4 {
        let (along, inward, middle, half) = frame_of_side(guess, k);
        values.fill(0.0);
        for place in -2..=2 {
            let base = middle + along * (half * 0.25 * f64::from(place));
            let outermost = base - inward * ((search + width) as f64 * STEP);
            for (step, value) in values.iter_mut().enumerate() {
                let at = ViewPixel(outermost + inward * (step as f64 * STEP));
                // What is outside the image is no step at all: a NaN is in no sum that counts.
                *value += light.at(image, at).unwrap_or(f32::NAN);
            }
        }
        let falls = |at: usize| {
            let outside: f32 = values[at..at + width].iter().sum();
            let inside: f32 = values[at + width + 1..at + 2 * width + 1].iter().sum();
            outside - inside
        };
        let steepest = (0..=2 * search)
            .map(|at| (at, falls(at)))
            .filter(|(_, fall)| fall.is_finite())
            .max_by(|a, b| a.1.total_cmp(&b.1))?;
        let line = EdgeLine::level((steepest.0 as f64 - search as f64) * STEP);
        moved.push((Side { middle, along, inward, half, step: STEP, profiles: Vec::new() }, line));
    }
    let corner = |k: usize| {
        let ((before, before_line), (side, line)) = (&moved[(k + 3) % 4], &moved[k]);
        cross((before, before_line), (side, line)).map(|corner| corner.0)
    };
    Some([corner(0)?, corner(1)?, corner(2)?, corner(3)?])
}
