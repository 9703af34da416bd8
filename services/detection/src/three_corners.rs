//! Squares of which one corner is lost.
//!
//! A marker that touches something dark with one corner has no outline of its own: one outline goes
//! around both. But it holds three of the marker's corners, and the beginnings of the two sides
//! that lead to the fourth.

use flockeye_geometry::view::ViewPixel;
use flockeye_imaging::image::LumaImage;
use nalgebra::Vector2;

use crate::outlines::Pixel;
use crate::quad::Quad;

// Limits on the corners of a possible square. They are wide, because every candidate is still read:
// `tests/recall.rs` draws markers with a strut across one corner and counts the detections.

/// Least ratio of the singular values of two neighbouring sides, which is the cosine of a square's
/// tilt about any axis. Markers tilted by more than 69 degrees cannot be read.
const MIN_TILT_COSINE: f64 = 0.35;

/// Least cosine of the angle between the rest of a side and the opposite side.
const MIN_PARALLEL_COSINE: f64 = 0.85;

/// Least length of the rest of a side, as a share of the opposite side.
const MIN_REST_SHARE: f64 = 0.25;

/// Least length of the shorter seen side, as a share of the shortest side in the search, because a
/// tilt shortens one side.
const MIN_SEEN_SIDE_SHARE: f64 = 0.7;

/// Least number of the twelve places compared across the sides that must be dark inside and bright
/// outside. One of the two sides to the lost corner may be hidden.
const MIN_DARKER: u32 = 9;

/// The quadrilaterals from three successive corners of a closed polygon, clockwise. The polygon's
/// next vertex on either side must lie towards the fourth corner.
pub(crate) fn complete(polygon: &[Pixel], min_side_px: f64) -> impl Iterator<Item = Quad> + '_ {
    let count = polygon.len();
    // The polygon is closed: after the last corner comes the first.
    let at = move |k: usize| polygon[if k < count { k } else { k - count }].cast::<f64>();
    let shortest_px = MIN_SEEN_SIDE_SHARE * min_side_px;
    (0..if count < 5 { 0 } else { count }).filter_map(move |k| {
        let [before, a, b, c, after] = [0, 1, 2, 3, 4].map(|n| at(k + n));
        let (first, second) = (b - a, c - b);
        // Squared lengths, because most corners belong to no square, and roots would take most of
        // the time.
        let squares = (first.norm_squared(), second.norm_squared());
        // With the singular values s and t, this is s t, and the sum of the squares is s^2 + t^2.
        let turn = first.perp(&second);
        if squares.0.min(squares.1) < shortest_px.powi(2)
            || turn.abs() * (1.0 + MIN_TILT_COSINE.powi(2))
                < MIN_TILT_COSINE * (squares.0 + squares.1)
        {
            return None;
        }
        // The rest of the third side begins at c, opposite to the direction of the first side. The
        // rest of the fourth begins at a, along the second side.
        let (onwards, backwards) = (after - c, before - a);
        let is_rest = |rest: Vector2<f64>, side: Vector2<f64>| {
            rest.dot(&side) > MIN_PARALLEL_COSINE * rest.norm() * side.norm()
                && rest.norm() > MIN_REST_SHARE * side.norm()
        };
        if !(is_rest(onwards, -first) && is_rest(backwards, second)) {
            return None;
        }
        // The fourth corner is where the two sides meet.
        let sine = onwards.perp(&backwards);
        let share = (a - c).perp(&backwards) / sine;
        let fourth = c + onwards * share;
        // False for a NaN, as for parallel sides.
        let is_ahead = share > 0.0 && share.is_finite();
        if !is_ahead {
            return None;
        }
        let quad = if turn > 0.0 { [a, b, c, fourth] } else { [fourth, c, b, a] };
        Some(quad.map(ViewPixel))
    })
}

/// Whether a quadrilateral's sides are darker inside than outside by `darker_by` code values, at
/// [`MIN_DARKER`] of twelve places.
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
    darker >= MIN_DARKER
}

#[cfg(test)]
mod tests {
    use super::*;

    fn polygon(corners: &[(i32, i32)]) -> Vec<Pixel> {
        corners.iter().map(|&(x, y)| Pixel::new(x, y)).collect()
    }

    #[test]
    fn a_lost_corner_is_where_the_sides_meet() {
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
            // Clockwise in both directions; in the reversed outline the lost corner comes first.
            let mut expected = polygon(&[(10, 30), (10, 10), (30, 10), (30, 30)]);
            expected.rotate_right(usize::from(reversed));
            for (corner, expected) in found[0].iter().zip(expected) {
                assert!((corner.0 - expected.cast()).norm() < 1e-9, "{found:?}");
            }
        }
    }

    #[test]
    fn other_outlines_give_no_square() {
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
