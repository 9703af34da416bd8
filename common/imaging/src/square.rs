//! The perspective image of a printed square in a view.

use flockeye_geometry::view::ViewPixel;
use nalgebra::{Matrix3, Vector2};

/// The perspective map from a unit square to a view: (0, 0) is the printed top left corner,
/// (1, 0) the top right, (1, 1) the bottom right.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SquareInView {
    /// The homography from the square to the view.
    pub(crate) view_from_square: Matrix3<f64>,
    square_from_view: Matrix3<f64>,
}

impl SquareInView {
    /// The map from the unit square's corners to `corners_in_view`, in ArUco's order (clockwise
    /// from the top left). `None` unless these are a convex quadrilateral, clockwise in the image,
    /// like a marker seen from its front.
    ///
    /// Source: P. Heckbert, Fundamentals of Texture Mapping and Image Warping (1989), 2.2.3.
    pub fn new(corners_in_view: &[ViewPixel; 4]) -> Option<Self> {
        let corner = corners_in_view.map(|pixel| pixel.0);
        let convex = (0..4).all(|k| {
            let (a, b, c) = (corner[k], corner[(k + 1) % 4], corner[(k + 2) % 4]);
            // Positive for a turn to the right, because y points down. False for a NaN.
            (b - a).perp(&(c - b)) > 1e-9
        });
        if !convex {
            return None;
        }
        let [p0, p1, p2, p3] = corner;
        let (side, other, sum) = (p1 - p2, p3 - p2, p0 - p1 + p2 - p3);
        let determinant = side.perp(&other);
        let g = sum.perp(&other) / determinant;
        let h = side.perp(&sum) / determinant;
        let (x_axis, y_axis) = (p1 - p0 + p1 * g, p3 - p0 + p3 * h);
        let view_from_square =
            Matrix3::new(x_axis.x, y_axis.x, p0.x, x_axis.y, y_axis.y, p0.y, g, h, 1.0);
        let square_from_view = view_from_square.try_inverse()?;
        Some(Self { view_from_square, square_from_view })
    }

    /// The pixel of the point (`u`, `v`) of the square's plane.
    pub fn at(&self, u: f64, v: f64) -> ViewPixel {
        ViewPixel(mapped(&self.view_from_square, Vector2::new(u, v)))
    }

    /// The point (u, v) of the square's plane at `pixel`.
    pub fn seen_at(&self, pixel: ViewPixel) -> (f64, f64) {
        let point = mapped(&self.square_from_view, pixel.0);
        (point.x, point.y)
    }
}

fn mapped(homography: &Matrix3<f64>, point: Vector2<f64>) -> Vector2<f64> {
    let mapped = homography * point.push(1.0);
    mapped.xy() / mapped.z
}

/// Mean length of the sides of a quadrilateral, pixels.
pub fn mean_side_px(corners_in_view: &[ViewPixel; 4]) -> f64 {
    (0..4).map(|k| (corners_in_view[(k + 1) % 4].0 - corners_in_view[k].0).norm()).sum::<f64>()
        / 4.0
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    const CORNERS: [(f64, f64); 4] = [(10.0, 12.0), (40.0, 9.0), (45.0, 50.0), (8.0, 39.0)];

    #[test]
    fn corners_map_to_corners_and_diagonals_cross_in_the_middle() {
        let corners = CORNERS.map(|(x, y)| ViewPixel::new(x, y));
        let square = SquareInView::new(&corners).unwrap();
        for ((u, v), corner) in [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)].iter().zip(corners)
        {
            assert!((square.at(*u, *v).0 - corner.0).norm() < 1e-9);
            let back = square.seen_at(corner);
            assert!((back.0 - u).abs() < 1e-9 && (back.1 - v).abs() < 1e-9);
        }
        let middle = square.at(0.5, 0.5).0;
        for (a, b) in [(0, 2), (1, 3)] {
            let along = (corners[b].0 - corners[a].0).normalize();
            assert!(along.perp(&(middle - corners[a].0)).abs() < 1e-9);
        }
    }

    #[test]
    fn quadrilaterals_that_are_not_a_square_seen_from_its_front_are_refused() {
        let mut corners = CORNERS.map(|(x, y)| ViewPixel::new(x, y));
        corners.reverse();
        assert_eq!(SquareInView::new(&corners), None);
        let point = [ViewPixel::new(3.0, 3.0); 4];
        assert_eq!(SquareInView::new(&point), None);
        let not_a_number = [ViewPixel::new(f64::NAN, 3.0); 4];
        assert_eq!(SquareInView::new(&not_a_number), None);
    }
}
