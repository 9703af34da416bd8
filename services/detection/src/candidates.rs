//! Squares in a view.
//!
//! The steps are those of OpenCV's ArUco. Pixels darker than their surroundings are found
//! ([`crate::darkness`]), their outlines are followed ([`crate::outlines`]), and outlines that are
//! nearly quadrilaterals ([`crate::polygon`]) are squares. OpenCV loses a square that touches
//! something dark with one corner, because the outline continues around that object.
//! [`crate::three_corners`] completes such squares.

use flockeye_geometry::view::ViewPixel;
use flockeye_imaging::image::LumaImage;

use crate::darkness::Darkness;
use crate::outlines::{Encloses, Follower, Pixel};
use crate::parameters::DetectorParameters;
use crate::polygon::Approximator;
use crate::quad::Quad;
use crate::three_corners;

/// Least pixels in the outline of a square, for each pixel of its side. A square that stands on its
/// corner has the shortest outline, because its pixels join diagonally: 4 / sqrt 2 = 2.8, less some
/// for what blur takes away.
const MIN_OUTLINE_PER_SIDE: f64 = 2.4;

/// Longest outline of a square, in sides of the view: a square as large as the view has four.
const MAX_OUTLINE_PER_VIEW: f64 = 4.0;

/// Largest deviation of an outline from a quadrilateral, as a share of its length. Decides how
/// rounded the corners of small markers may be.
const POLYGON_ACCURACY: f64 = 0.05;

/// Shortest side and diagonal of a quadrilateral, as a share of its outline. OpenCV's
/// `minCornerDistanceRate` has the same default.
const MIN_SIDE_SHARE: f64 = 0.05;

/// Least distance of a corner from the image's border, pixels: nearer, the quiet zone is not in the
/// image.
const MIN_TO_BORDER_PX: f64 = 1.0;

/// The squares in an image.
#[derive(Debug, Default)]
pub struct Candidates {
    /// Outlines that are quadrilaterals.
    pub whole: Vec<Square>,
    /// Squares of which three corners are seen, with the fourth computed from them.
    pub completed: Vec<Square>,
}

/// A dark quadrilateral in an image.
#[derive(Debug, Clone, Copy)]
pub struct Square {
    /// Its corners.
    pub corners: Quad,
    /// Distance that the outline may have from its sides, pixels.
    pub accuracy_px: f64,
}

/// Finds squares; reuses its memory for the next image.
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
        let shortest = (MIN_OUTLINE_PER_SIDE * parameters.min_side_px) as usize;
        let longest = (MAX_OUTLINE_PER_VIEW * image.width().max(image.height()) as f64) as usize;
        for &threshold in &parameters.thresholds {
            let dark = self.darkness.of(image, threshold);
            let outlines = self.follower.follow(dark, shortest..=longest);
            for (encloses, outline) in outlines.iter() {
                let length = outline.len() as f64;
                self.approximator.set_outline(outline);
                let accuracy_px = POLYGON_ACCURACY * length;
                // An outline around a hole is bright inside, so it belongs to no marker.
                let whole = (encloses == Encloses::Dark).then(|| {
                    let polygon = self.approximator.approximate(accuracy_px);
                    quad_of(polygon, MIN_SIDE_SHARE * length, image)
                });
                let whole = whole.flatten().map(|corners| Square { corners, accuracy_px });
                // For so short an outline the second polygon would be no finer.
                if accuracy_px <= parameters.corner_accuracy_px {
                    found.whole.extend(whole);
                    continue;
                }
                let accuracy_px = parameters.corner_accuracy_px;
                let polygon = self.approximator.approximate(accuracy_px);
                found.whole.extend(whole.map(|square| match polygon.len() {
                    4 => Square { accuracy_px, ..square },
                    _ => square,
                }));
                let completed = three_corners::complete(polygon, parameters.min_side_px);
                let completed = completed.filter(|quad| {
                    three_corners::is_dark_inside(image, quad, threshold.darker_by.codes().into())
                });
                found.completed.extend(completed.map(|corners| Square { corners, accuracy_px }));
            }
        }
        found
    }
}

/// The polygon, clockwise, if it is a convex quadrilateral with sides and diagonals of at least
/// `min_side_px`, and not too near to the image's border.
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
    // With y pointing down, a turn to the right is positive.
    if turn(0) < 0.0 {
        corners.reverse();
    }
    (is_convex && is_large && is_inside).then(|| corners.map(ViewPixel))
}
