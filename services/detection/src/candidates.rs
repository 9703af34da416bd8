//! Squares in a view, as OpenCV's ArUco finds them.

use std::ffi::c_void;

use flockeye_dictionary::Dictionary;
use flockeye_geometry::view::ViewPixel;
use flockeye_imaging::image::LumaImage;
use opencv::aruco::{self, CORNER_REFINE_NONE, DetectorParameters as CvParameters};
use opencv::boxed_ref::BoxedRef;
use opencv::core::{CV_8UC1, Mat, Point2f, Ptr, Vector};
use opencv::prelude::*;

use crate::{DetectError, DetectorParameters, Threshold};

/// A contour of a square with sides of s pixels has at least this many: those of a square on its
/// corner, whose pixels join by their corners (4 s / sqrt 2), less some for what blur takes away.
const CONTOUR_PER_SIDE: f64 = 2.4;

/// A convex quadrilateral that is dark inside, clockwise from any of its corners.
pub type Quad = [ViewPixel; 4];

/// Every quadrilateral in `image`, whether OpenCV could read a marker in it or not.
///
/// # Errors
/// What OpenCV says.
pub fn find(
    image: &LumaImage<'_>,
    dictionary: &Dictionary,
    parameters: &DetectorParameters,
) -> Result<Vec<Quad>, DetectError> {
    let mat = borrow(image)?;
    let mut quads = Vec::new();
    for threshold in &parameters.thresholds {
        let mut decoded = Vector::<Vector<Point2f>>::new();
        let mut ids = Vector::<i32>::new();
        let mut rejected = Vector::<Vector<Point2f>>::new();
        let opencv = opencv_parameters(image, parameters, *threshold)?;
        aruco::detect_markers(
            &mat,
            dictionary.opencv(),
            &mut decoded,
            &mut ids,
            &opencv,
            &mut rejected,
        )?;
        quads.extend(decoded.iter().chain(&rejected).filter_map(|quad| quad_of(&quad)));
    }
    Ok(quads)
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

/// A new set each time: OpenCV writes into what it is given.
fn opencv_parameters(
    image: &LumaImage<'_>,
    parameters: &DetectorParameters,
    threshold: Threshold,
) -> Result<Ptr<CvParameters>, DetectError> {
    let mut opencv = CvParameters::create()?;
    let size = image.width().max(image.height()) as f64;
    opencv.set_adaptive_thresh_win_size_min(threshold.window_px);
    opencv.set_adaptive_thresh_win_size_max(threshold.window_px);
    opencv.set_adaptive_thresh_constant(threshold.darker_by);
    opencv.set_min_marker_perimeter_rate(CONTOUR_PER_SIDE * parameters.min_side_px / size);
    opencv.set_polygonal_approx_accuracy_rate(parameters.polygon_accuracy);
    opencv.set_min_distance_to_border(1);
    opencv.set_corner_refinement_method(CORNER_REFINE_NONE);
    Ok(opencv)
}

fn quad_of(corners: &Vector<Point2f>) -> Option<Quad> {
    let corner = |k| {
        let point = corners.get(k).ok()?;
        Some(ViewPixel::new(f64::from(point.x), f64::from(point.y)))
    };
    Some([corner(0)?, corner(1)?, corner(2)?, corner(3)?])
}
