//! Polygons for outlines (D. Douglas and T. Peucker, "Algorithms for the reduction of the number of
//! points required to represent a digitized line or its caricature", 1973).

use crate::outlines::Pixel;

/// Approximates closed outlines; keeps its memory from one to the next.
#[derive(Debug, Default)]
pub(crate) struct Approximator {
    /// The outline from one of its corners on, once round.
    points: Vec<Pixel>,
    /// Stretches of it that are still to be looked at, the next one last.
    stretches: Vec<(usize, usize)>,
    polygon: Vec<Pixel>,
}

impl Approximator {
    /// Corners of a polygon from which no point of a closed outline is farther than `accuracy_px`, or twice
    /// that where [`Self::drop_straight`] left out a corner; in the outline's order. At least one, if there
    /// is any point.
    pub(crate) fn approximate(&mut self, outline: &[Pixel], accuracy_px: f64) -> &[Pixel] {
        self.polygon.clear();
        let Some(&first) = outline.first() else { return &self.polygon };
        // Two points that are far from each other are corners.
        let start = farthest(outline, |point| squared(*point - first));
        self.points.clear();
        self.points.extend_from_slice(&outline[start..]);
        self.points.extend_from_slice(&outline[..=start]);
        let middle = farthest(&self.points, |point| squared(*point - outline[start]));
        let last = self.points.len() - 1;
        if middle == 0 {
            self.polygon.push(first);
            return &self.polygon;
        }
        let limit = accuracy_px * accuracy_px;
        self.stretches.clear();
        self.stretches.extend([(middle, last), (0, middle)]);
        while let Some((from, to)) = self.stretches.pop() {
            let (start, along) = (self.points[from], self.points[to] - self.points[from]);
            let inner = &self.points[from + 1..to];
            // From the line, times the line's length; from its point where it has none.
            let is_line = along != Pixel::zeros();
            let off = |point: &Pixel| match is_line {
                true => i64::from(along.perp(&(*point - start)).abs()),
                false => squared(*point - start),
            };
            let at = farthest(inner, off);
            let is_off = inner.get(at).map(off).is_some_and(|off| match is_line {
                true => (off as f64).powi(2) > limit * squared(along) as f64,
                false => off as f64 > limit,
            });
            if is_off {
                let at = from + 1 + at;
                self.stretches.extend([(at, to), (from, at)]);
            } else {
                self.polygon.push(start);
            }
        }
        self.drop_straight(limit);
        &self.polygon
    }

    /// Leaves out corners that the line between their neighbours passes, no two beside each other: those
    /// to start from need not have been any.
    fn drop_straight(&mut self, limit: f64) {
        let mut at = 0;
        while self.polygon.len() > 2 && at < self.polygon.len() {
            let count = self.polygon.len();
            let before = self.polygon[(at + count - 1) % count];
            let (here, after) = (self.polygon[at], self.polygon[(at + 1) % count]);
            let along = after - before;
            let off = f64::from(along.perp(&(here - before))).powi(2);
            let is_onwards = (here - before).dot(&(after - here)) >= 0;
            if is_onwards && off <= 0.5 * limit * squared(along) as f64 {
                self.polygon.remove(at);
            }
            at += 1;
        }
    }
}

/// Index of the point for which that is largest; 0 of none.
fn farthest(points: &[Pixel], distance: impl Fn(&Pixel) -> i64) -> usize {
    let mut best = (0, 0);
    for (index, point) in points.iter().enumerate() {
        let distance = distance(point);
        if distance > best.1 {
            best = (index, distance);
        }
    }
    best.0
}

/// Views are some thousand pixels wide, so that products of their coordinates fit an `i32`.
fn squared(a: Pixel) -> i64 {
    i64::from(a.dot(&a))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use opencv::core::{Mat, Point, Vector};
    use opencv::imgproc::approx_poly_dp;
    use proptest::prelude::*;

    use super::*;

    fn from_line(point: Pixel, from: Pixel, to: Pixel) -> f64 {
        let [point, from, to] = [point, from, to].map(|pixel| pixel.cast::<f64>());
        let along = to - from;
        let share = (point - from).dot(&along) / along.norm_squared().max(1e-9);
        (point - from - along * share.clamp(0.0, 1.0)).norm()
    }

    fn from_polygon(point: Pixel, polygon: &[Pixel]) -> f64 {
        let next = polygon.iter().cycle().skip(1);
        let sides = polygon.iter().zip(next).map(|(&from, &to)| from_line(point, from, to));
        sides.fold(f64::INFINITY, f64::min)
    }

    /// The outline of a square of such a side, turned, from one of its pixels on.
    fn square(side: f64, turn: f64, first: usize) -> ([[f64; 2]; 4], Vec<Pixel>) {
        let (sine, cosine) = turn.sin_cos();
        let corners = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)].map(|(x, y)| {
            let (x, y) = (x * side / 2.0, y * side / 2.0);
            [100.0 + cosine * x - sine * y, 100.0 + sine * x + cosine * y]
        });
        let steps = side.ceil() as i32;
        let mut outline: Vec<Pixel> = (0..4)
            .flat_map(|k| (0..steps).map(move |step| (k, f64::from(step) / f64::from(steps))))
            .map(|(k, share): (usize, f64)| {
                let ([x, y], [to_x, to_y]) = (corners[k], corners[(k + 1) % 4]);
                let at = [x + share * (to_x - x), y + share * (to_y - y)];
                Pixel::new(at[0].round() as i32, at[1].round() as i32)
            })
            .collect();
        let first = first % outline.len();
        outline.rotate_left(first);
        (corners, outline)
    }

    proptest! {
        #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

        #[test]
        fn no_point_is_far_from_its_polygon(
            radii in prop::collection::vec(20.0..40.0f64, 12..80),
            accuracy_px in 1.0..6.0f64,
        ) {
            let step = std::f64::consts::TAU / radii.len() as f64;
            let pixel = |(k, radius): (usize, &f64)| {
                let (sine, cosine) = (step * k as f64).sin_cos();
                Pixel::new((radius * cosine).round() as i32, (radius * sine).round() as i32)
            };
            let outline: Vec<Pixel> = radii.iter().enumerate().map(pixel).collect();
            let mut approximator = Approximator::default();
            let polygon = approximator.approximate(&outline, accuracy_px);
            prop_assert!(polygon.iter().all(|corner| outline.contains(corner)));
            for &point in &outline {
                let off = from_polygon(point, polygon);
                prop_assert!(off < 2.0 * accuracy_px, "{} off by {}", point, off);
            }
        }

        #[test]
        fn a_rough_square_has_four_corners_as_in_opencv(
            turn in 0.0..std::f64::consts::TAU,
            side in 16.0..60.0f64,
            first in 0usize..1000,
        ) {
            let (corners, outline) = square(side, turn, first);
            let accuracy_px = 0.05 * outline.len() as f64;
            let mut approximator = Approximator::default();
            let polygon = approximator.approximate(&outline, accuracy_px).to_vec();
            prop_assert_eq!(polygon.len(), 4, "{:?}", polygon);
            for [x, y] in corners {
                let near = |corner: &Pixel| (f64::from(corner.x) - x).hypot(f64::from(corner.y) - y);
                prop_assert!(polygon.iter().map(near).fold(f64::INFINITY, f64::min) < 3.0);
            }
            for &point in &outline {
                prop_assert!(from_polygon(point, &polygon) < accuracy_px);
            }
            let points: Vec<Point> = outline.iter().map(|p| Point::new(p.x, p.y)).collect();
            let mut theirs = Vector::<Point>::new();
            let points = Mat::from_slice(&points).unwrap();
            approx_poly_dp(&points, &mut theirs, accuracy_px, true).unwrap();
            prop_assert_eq!(theirs.len(), 4);
            for corner in theirs {
                let corner = Pixel::new(corner.x, corner.y).cast::<f64>();
                let near = |ours: &Pixel| (ours.cast::<f64>() - corner).norm();
                prop_assert!(polygon.iter().map(near).fold(f64::INFINITY, f64::min) < 3.0);
            }
        }
    }

    #[test]
    fn small_outlines_are_what_they_are() {
        let mut approximator = Approximator::default();
        assert!(approximator.approximate(&[], 1.0).is_empty());
        let point = [Pixel::new(3, 4)];
        assert_eq!(approximator.approximate(&point, 1.0), point);
    }

    /// A square on a neck of one pixel: the outline comes back through where it went.
    #[test]
    fn what_hangs_on_a_neck_is_not_lost() {
        let (_, square) = square(20.0, 0.0, 0);
        let neck = (0..30).map(|k| square[0] - Pixel::new(30 - k, 0));
        let back = neck.clone().rev();
        let outline: Vec<Pixel> = neck.chain(square.iter().copied()).chain(back).collect();
        let mut approximator = Approximator::default();
        let polygon = approximator.approximate(&outline, 2.0);
        assert!(outline.iter().all(|&point| from_polygon(point, polygon) < 4.0), "{polygon:?}");
    }
}
