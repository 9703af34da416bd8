//! The corners of a marker in a view, and their comparison.

use flockeye_geometry::view::ViewPixel;

use super::print::MarkerPrint;
use crate::square::{SquareInView, mean_side_px};

/// Corners of a marker's black square, with their precision.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RefinedCorners {
    /// The corners, in the order of the guesses.
    pub corners_in_view: [ViewPixel; 4],
    /// Standard deviation of each corner along either axis, pixels.
    pub sigmas_px: [f64; 4],
    /// Blur across the first and third side, then the second and fourth, standard deviation,
    /// pixels.
    pub blur_px: [f64; 2],
    /// Radiance of the quiet zone.
    pub white: f64,
    /// Radiance of the border.
    pub black: f64,
    /// Robust deviation of the radiance from the blurred print, as a share of the contrast.
    pub residual_sigma: f64,
}

/// Largest difference between corners from the edges and from the whole print, standard deviations.
const AGREED_SIGMAS: f64 = 5.0;

/// Whether corners from the whole print match those from the edges; a shadow or an object may spoil
/// the fit.
pub(super) fn agree(whole: &RefinedCorners, edges: &RefinedCorners, print: &MarkerPrint) -> bool {
    (0..4).all(|k| {
        let apart = (whole.corners_in_view[k].0 - edges.corners_in_view[k].0).norm();
        let by_edges_px = without_whole(edges.sigmas_px[k], edges, print);
        apart <= AGREED_SIGMAS * whole.sigmas_px[k].hypot(by_edges_px)
    })
}

/// Standard deviation of corners from edges alone, larger than their scatter. The whole print did
/// not fit: a part of it is occluded, or its cells are hardly wider than the blur.
pub(super) fn without_whole(sigma_px: f64, edges: &RefinedCorners, print: &MarkerPrint) -> f64 {
    let corners = &edges.corners_in_view;
    let narrowest = (0..4)
        .map(|k| (corners[(k + 1) % 4].0 - corners[k].0).norm())
        .fold(f64::INFINITY, f64::min)
        / print.cells() as f64;
    let blur = edges.blur_px[0].max(edges.blur_px[1]);
    (2.0 * sigma_px).hypot(0.5 * (blur / narrowest).powi(2).min(1.0))
}

/// Whether the corners are near enough to the guess to be the same corners.
pub(super) fn is_near(corners: &[ViewPixel; 4], guess: &[ViewPixel; 4]) -> bool {
    let limit = 3.0 + 0.05 * mean_side_px(guess);
    corners.iter().zip(guess).all(|(a, b)| (a.0 - b.0).norm() <= limit)
        && SquareInView::new(corners).is_some()
}
