//! Quadrilaterals in a view.

use flockeye_geometry::view::ViewPixel;
use nalgebra::Vector2;

/// A convex quadrilateral that is dark inside, clockwise from any of its corners.
pub type Quad = [ViewPixel; 4];

pub(crate) fn centre(corners: &Quad) -> Vector2<f64> {
    corners.iter().map(|corner| corner.0).sum::<Vector2<f64>>() / 4.0
}

/// Returns the quadrilateral, beginning with the corner of index `first`.
pub(crate) fn rotated(corners: &Quad, first: usize) -> Quad {
    std::array::from_fn(|k| corners[(k + first) % 4])
}

/// The quadrilateral with corner `k` replaced by the one that completes a parallelogram with the
/// other three. Outlines lose a corner where something dark touches it.
pub(crate) fn with_parallelogram_corner(corners: &Quad, k: usize) -> Quad {
    let mut completed = *corners;
    let [before, after, opposite] = [3, 1, 2].map(|n| corners[(k + n) % 4].0);
    completed[k] = ViewPixel(before + after - opposite);
    completed
}

#[cfg(test)]
mod tests {
    use super::*;

    const SQUARE: [[f64; 2]; 4] = [[10.0, 10.0], [30.0, 10.0], [30.0, 30.0], [10.0, 30.0]];

    #[test]
    fn a_lost_corner_of_a_square_is_put_back() {
        let square = SQUARE.map(|[x, y]| ViewPixel::new(x, y));
        for k in 0..4 {
            let mut lost = square;
            lost[k] = ViewPixel::new(17.0, 22.0);
            assert_eq!(with_parallelogram_corner(&lost, k), square);
        }
    }

    #[test]
    fn rotation_keeps_the_order_and_the_centre() {
        let square = SQUARE.map(|[x, y]| ViewPixel::new(x, y));
        let rotated = rotated(&square, 3);
        assert_eq!(rotated, [square[3], square[0], square[1], square[2]]);
        assert_eq!(centre(&rotated), Vector2::new(20.0, 20.0));
    }
}
