//! Squares in a view.
//!
//! As OpenCV's ArUco finds them: what is darker than its surroundings ([`crate::darkness`]) is followed
//! round ([`crate::outlines`]), and outlines that are nearly quadrilaterals ([`crate::polygon`]) are
//! squares. But OpenCV loses a square that touches something dark by one corner: there its outline runs
//! on. [`crate::three_corners`] completes those.

use flockeye_geometry::view::ViewPixel;
use flockeye_imaging::image::LumaImage;

use crate::darkness::Darkness;
use crate::outlines::{Follower, Pixel, Round};
use crate::polygon::Approximator;
use crate::{DetectorParameters, three_corners};

/// The outline of a square with sides of s pixels has at least this many: those of a square on its
/// corner, whose pixels join by their corners (4 s / sqrt 2), less some for what blur takes away.
const OUTLINE_PER_SIDE: f64 = 2.4;

/// Outlines longer than this many times the sides of the view belong to no square in it.
const MAX_OUTLINE: f64 = 4.0;

/// Corners nearer to each other than this share of the outline make no square.
const MIN_SIDE: f64 = 0.05;

/// Squares nearer to the image's border have no quiet zone in it, pixels.
const MIN_TO_BORDER_PX: f64 = 1.0;

/// A convex quadrilateral that is dark inside, clockwise from any of its corners.
pub type Quad = [ViewPixel; 4];

/// The squares in an image.
#[derive(Debug, Default)]
pub struct Candidates {
    /// Outlines that are quadrilaterals.
    pub whole: Vec<Quad>,
    /// Those of which three corners are seen, and the fourth is where it should be.
    pub completed: Vec<Quad>,
}

/// Finds squares; keeps its memory from image to image.
#[derive(Debug, Default)]
pub struct Finder {
    darkness: Darkness,
    follower: Follower,
    approximator: Approximator,
}

impl Finder {
    /// Every quadrilateral in `image`, whatever is printed in it.
    pub fn find(&mut self, image: &LumaImage<'_>, parameters: &DetectorParameters) -> Candidates {
        let mut found = Candidates::default();
        let shortest = (OUTLINE_PER_SIDE * parameters.min_side_px) as usize;
        let longest = (MAX_OUTLINE * image.width().max(image.height()) as f64) as usize;
        for &threshold in &parameters.thresholds {
            let dark = self.darkness.of(image, threshold);
            let outlines = self.follower.follow(dark, shortest..=longest);
            for (round, outline) in outlines.iter() {
                let length = outline.len() as f64;
                self.approximator.set_outline(outline);
                let accuracy_px = parameters.polygon_accuracy * length;
                // What goes round a hole is bright inside, and so no marker.
                if round == Round::Dark {
                    let polygon = self.approximator.approximate(accuracy_px);
                    if let Some(quad) = quad_of(polygon, MIN_SIDE * length, image) {
                        found.whole.push(quad);
                        continue;
                    }
                }
                // Nothing finer is seen of what is so short.
                if accuracy_px <= parameters.corner_accuracy_px {
                    continue;
                }
                let polygon = self.approximator.approximate(parameters.corner_accuracy_px);
                let completed = three_corners::complete(polygon, parameters.min_side_px);
                found.completed.extend(completed.filter(|quad| {
                    three_corners::is_dark_inside(image, quad, threshold.darker_by.into())
                }));
            }
        }
        found
    }
}

/// The polygon, if it is a convex quadrilateral with sides of at least `min_side_px` that keeps off
/// the image's border; clockwise.
fn quad_of(polygon: &[Pixel], min_side_px: f64, image: &LumaImage<'_>) -> Option<Quad> {
    let polygon: &[Pixel; 4] = polygon.try_into().ok()?;
    let mut corners = polygon.map(|pixel| pixel.cast::<f64>());
    let turn = |k: usize| {
        let (a, b, c) = (corners[k], corners[(k + 1) % 4], corners[(k + 2) % 4]);
        (b - a).perp(&(c - b))
    };
    let is_convex = (0..4).all(|k| turn(k) > 0.0) || (0..4).all(|k| turn(k) < 0.0);
    let apart = (0..4).flat_map(|a| (0..a).map(move |b| (a, b)));
    let is_large = apart.map(|(a, b)| (corners[a] - corners[b]).norm()).all(|d| d >= min_side_px);
    let last = [image.width(), image.height()].map(|size| size as f64 - 1.0 - MIN_TO_BORDER_PX);
    let is_inside = corners
        .iter()
        .all(|corner| (0..2).all(|k| (MIN_TO_BORDER_PX..=last[k]).contains(&corner[k])));
    // Where y points down, a turn to the right is positive.
    if turn(0) < 0.0 {
        corners.reverse();
    }
    (is_convex && is_large && is_inside).then(|| corners.map(ViewPixel))
}
