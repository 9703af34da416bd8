//! Squares of whose outline one corner is lost.
//!
//! A marker that touches something dark by one corner has no outline of its own: the thing's runs
//! round both. But three corners and the beginnings of the two sides to the fourth are in it.

use flockeye_geometry::view::ViewPixel;
use flockeye_imaging::image::LumaImage;
use nalgebra::Vector2;

use crate::candidates::Quad;
use crate::outlines::Pixel;

/// Of two neighbouring sides the shorter one is at least this share of the longer one: what is
/// tilted further cannot be read.
const MIN_SIDES: f64 = 0.35;

/// Sides at a corner enclose at least an angle with this sine.
const MIN_SINE: f64 = 0.35;

/// What is left of a side points along the opposite one to within an angle with this cosine.
const MIN_PARALLEL: f64 = 0.85;

/// What is left of a side is at least this share of the opposite one.
const MIN_LEFT: f64 = 0.25;

/// The quadrilaterals that three neighbouring corners of a closed polygon promise: whose next corner
/// on either side lies where a fourth corner would be seen from there. Clockwise.
pub(crate) fn complete(polygon: &[Pixel], min_side_px: f64) -> impl Iterator<Item = Quad> + '_ {
    let count = polygon.len();
    // From the last corner on to the first again.
    let at = move |k: usize| polygon[if k < count { k } else { k - count }].cast::<f64>();
    let shortest_px = 0.7 * min_side_px;
    (0..if count < 5 { 0 } else { count }).filter_map(move |k| {
        let [before, a, b, c, after] = [0, 1, 2, 3, 4].map(|n| at(k + n));
        let (first, second) = (b - a, c - b);
        // Squared: most corners are no square's, and roots take longer than all else.
        let squares = (first.norm_squared(), second.norm_squared());
        let (shorter, longer) = (squares.0.min(squares.1), squares.0.max(squares.1));
        let turn = first.perp(&second);
        if shorter < shortest_px.powi(2)
            || shorter < MIN_SIDES.powi(2) * longer
            || turn * turn < MIN_SINE.powi(2) * squares.0 * squares.1
        {
            return None;
        }
        // From c on parallel to the first side, backwards; from a parallel to the second.
        let (onwards, backwards) = (after - c, before - a);
        let is_left = |rest: Vector2<f64>, side: Vector2<f64>| {
            rest.dot(&side) > MIN_PARALLEL * rest.norm() * side.norm()
                && rest.norm() > MIN_LEFT * side.norm()
        };
        if !(is_left(onwards, -first) && is_left(backwards, second)) {
            return None;
        }
        // Where the two sides cross.
        let sine = onwards.perp(&backwards);
        let share = (a - c).perp(&backwards) / sine;
        let fourth = c + onwards * share;
        let length = share * onwards.norm();
        let opposite = squares.0.sqrt();
        if !(length > 0.5 * opposite && length < 2.0 * opposite) {
            return None;
        }
        let quad = if turn > 0.0 { [a, b, c, fourth] } else { [fourth, c, b, a] };
        Some(quad.map(ViewPixel))
    })
}

/// Whether the sides of a quadrilateral are dark inside and brighter outside, by `darker_by` code
/// values, at nearly all places looked at.
pub(crate) fn is_dark_inside(image: &LumaImage<'_>, quad: &Quad, darker_by: f64) -> bool {
    const SHARES: [f64; 3] = [0.25, 0.5, 0.75];
    let code = |at: Vector2<f64>| -> Option<f64> {
        let (x, y) = (at.x.round(), at.y.round());
        let is_inside =
            x >= 0.0 && y >= 0.0 && x < image.width() as f64 && y < image.height() as f64;
        is_inside.then(|| f64::from(image.row(y as usize)[x as usize]))
    };
    let mut darker = 0;
    for k in 0..4 {
        let (from, to) = (quad[k].0, quad[(k + 1) % 4].0);
        let along = to - from;
        let inward = Vector2::new(-along.y, along.x) / along.norm();
        let step = (0.06 * along.norm()).clamp(1.5, 4.0);
        for share in SHARES {
            let at = from + along * share;
            let (Some(inside), Some(outside)) =
                (code(at + inward * step), code(at - inward * step))
            else {
                return false;
            };
            darker += u32::from(outside - inside > darker_by);
        }
    }
    // One of the two sides to the lost corner may be hidden for the better part.
    darker >= 9
}

#[cfg(test)]
mod tests {
    use super::*;

    fn polygon(corners: &[(i32, i32)]) -> Vec<Pixel> {
        corners.iter().map(|&(x, y)| Pixel::new(x, y)).collect()
    }

    #[test]
    fn a_lost_corner_is_where_the_sides_cross() {
        // A square from 10 to 30 whose bottom right corner runs into a bar.
        let outline =
            [(10, 10), (30, 10), (30, 22), (60, 22), (60, 34), (22, 34), (22, 30), (10, 30)];
        for reversed in [false, true] {
            let mut corners = polygon(&outline);
            if reversed {
                corners.reverse();
            }
            let found: Vec<Quad> = complete(&corners, 11.0).collect();
            assert_eq!(found.len(), 1, "{found:?}");
            // Clockwise either way; read backwards, the lost corner is the first.
            let mut expected = polygon(&[(10, 30), (10, 10), (30, 10), (30, 30)]);
            expected.rotate_right(usize::from(reversed));
            for (corner, expected) in found[0].iter().zip(expected) {
                assert!((corner.0 - expected.cast()).norm() < 1e-9, "{found:?}");
            }
        }
    }

    #[test]
    fn other_outlines_promise_nothing() {
        let ell = [(0, 0), (40, 0), (40, 5), (5, 5), (5, 40), (0, 40)];
        assert_eq!(complete(&polygon(&ell), 11.0).count(), 0);
        let square = [(0, 0), (40, 0), (40, 40), (0, 40)];
        assert_eq!(complete(&polygon(&square), 11.0).count(), 0);
        let at = |turn: f64| Vector2::new(turn.cos(), turn.sin()) * 400.0;
        let round: Vec<Pixel> =
            (0..24).map(|k| at(f64::from(k) * 0.26).map(|at| at.round() as i32)).collect();
        assert_eq!(complete(&round, 50.0).count(), 0);
    }
}
