//! Squares in a view.
//!
//! As OpenCV's ArUco finds them: what is darker than its surroundings is followed round, and outlines
//! that are nearly quadrilaterals are squares. But OpenCV loses a square that touches something
//! dark by one corner: there its outline runs on. [`crate::three_corners`] completes those.

use std::ffi::c_void;

use flockeye_geometry::view::ViewPixel;
use flockeye_imaging::image::LumaImage;
use nalgebra::Vector2;
use opencv::boxed_ref::BoxedRef;
use opencv::core::{CV_8UC1, Mat, Point, Vector};
use opencv::imgproc::{
    ADAPTIVE_THRESH_MEAN_C, CHAIN_APPROX_NONE, RETR_LIST, THRESH_BINARY_INV, adaptive_threshold,
    approx_poly_dp, find_contours,
};

use crate::{DetectError, DetectorParameters, three_corners};

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

/// Every quadrilateral in `image`, whatever is printed in it.
///
/// # Errors
/// What OpenCV says.
pub fn find(
    image: &LumaImage<'_>,
    parameters: &DetectorParameters,
) -> Result<Candidates, DetectError> {
    let mat = borrow(image)?;
    let mut found = Candidates::default();
    let mut dark = Mat::default();
    let mut polygon = Vector::<Point>::new();
    let shortest = (OUTLINE_PER_SIDE * parameters.min_side_px) as usize;
    let longest = (MAX_OUTLINE * image.width().max(image.height()) as f64) as usize;
    for threshold in &parameters.thresholds {
        adaptive_threshold(
            &mat,
            &mut dark,
            255.0,
            ADAPTIVE_THRESH_MEAN_C,
            THRESH_BINARY_INV,
            threshold.window_px,
            threshold.darker_by,
        )?;
        let mut outlines = Vector::<Vector<Point>>::new();
        find_contours(&dark, &mut outlines, RETR_LIST, CHAIN_APPROX_NONE, Point::new(0, 0))?;
        for outline in &outlines {
            if !(shortest..=longest).contains(&outline.len()) {
                continue;
            }
            let length = outline.len() as f64;
            approx_poly_dp(&outline, &mut polygon, length * parameters.polygon_accuracy, true)?;
            if let Some(quad) = quad_of(&polygon, MIN_SIDE * length, image) {
                found.whole.push(quad);
                continue;
            }
            approx_poly_dp(&outline, &mut polygon, parameters.corner_accuracy_px, true)?;
            let corners: Vec<Vector2<f64>> = polygon.iter().map(point).collect();
            let completed = three_corners::complete(&corners, parameters.min_side_px)
                .filter(|quad| three_corners::is_dark_inside(image, quad, threshold.darker_by));
            found.completed.extend(completed);
        }
    }
    Ok(found)
}

/// The image as OpenCV's matrix, without a copy.
fn borrow<'a>(image: &LumaImage<'a>) -> Result<BoxedRef<'a, Mat>, DetectError> {
    let pixels = image.pixels();
    // SAFETY: `LumaImage` guarantees that `height` rows of `width` bytes, `stride` apart, lie inside
    // `pixels`, and the matrix reads no further. The returned reference cannot outlive the memory
    // (its lifetime is that of the pixels) and gives no mutable access, so nothing is written.
    let mat = unsafe {
        Mat::new_rows_cols_with_data_unsafe(
            image.height() as i32,
            image.width() as i32,
            CV_8UC1,
            pixels.as_ptr().cast_mut().cast::<c_void>(),
            image.stride(),
        )
    }?;
    Ok(mat.into())
}

fn point(point: Point) -> Vector2<f64> {
    Vector2::new(f64::from(point.x), f64::from(point.y))
}

/// The polygon, if it is a convex quadrilateral with sides of at least `min_side_px` that keeps off
/// the image's border; clockwise.
fn quad_of(polygon: &Vector<Point>, min_side_px: f64, image: &LumaImage<'_>) -> Option<Quad> {
    if polygon.len() != 4 {
        return None;
    }
    let mut corners = [Vector2::zeros(); 4];
    for (corner, at) in corners.iter_mut().zip(polygon) {
        *corner = point(at);
    }
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
