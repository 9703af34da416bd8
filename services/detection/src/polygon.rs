//! Polygons for outlines (D. Douglas and T. Peucker, "Algorithms for the reduction of the number of
//! points required to represent a digitized line or its caricature", 1973).

use std::ops::Range;

use crate::outlines::Pixel;

/// Points whose largest distance is computed at once, before the point is searched among them.
/// Decides speed only.
const GROUP: usize = 64;

/// Approximates closed outlines; reuses its memory for the next one.
#[derive(Debug, Default)]
pub(crate) struct Approximator {
    /// The closed outline, beginning and ending with one of its corners.
    points: OutlinePoints,
    /// Indices of corners. The first corner is there twice, at the beginning and at the end, but
    /// for outlines of less than two points.
    corners: Vec<usize>,
    /// Ends of stretches that are still to be divided, the next one last.
    ends: Vec<usize>,
    polygon: Vec<Pixel>,
}

impl Approximator {
    /// Sets the outline to be approximated.
    pub(crate) fn set_outline(&mut self, outline: &[Pixel]) {
        self.points.clear();
        self.corners.clear();
        let Some(&first) = outline.first() else { return };
        // The division starts with two distant points as corners. The farthest point from an
        // arbitrary one may lie some pixels beside a corner. The farthest point from that one is
        // the first corner.
        self.points.extend(outline);
        let beside = self.points.farthest_from(first);
        let start = self.points.farthest_from(outline[beside]);
        let (before, after) = outline.split_at(start);
        self.points.clear();
        self.points.extend(after);
        self.points.extend(before);
        self.points.extend(&after[..1]);
        self.corners.push(0);
        match self.points.farthest_from(after[0]) {
            0 => {}
            middle => self.corners.extend([middle, outline.len()]),
        }
    }

    /// The corners of a polygon, in the outline's order; at least one, if the outline has any
    /// point.
    ///
    /// No point of the outline is farther from the polygon than `accuracy_px`, or twice that where
    /// [`Self::drop_straight`] removed a corner. A second call refines the first call's corners, so
    /// `accuracy_px` must not be larger then.
    pub(crate) fn approximate(&mut self, accuracy_px: f64) -> &[Pixel] {
        let limit = accuracy_px * accuracy_px;
        self.divide(limit);
        self.polygon.clear();
        let corners = self.corners.iter().take(1.max(self.corners.len().saturating_sub(1)));
        self.polygon.extend(corners.map(|&at| self.points.at(at)));
        self.drop_straight(limit);
        &self.polygon
    }

    /// Divides stretches that have a point farther from their line than the root of `limit`.
    fn divide(&mut self, limit: f64) {
        self.ends.clear();
        let first = self.corners.len().min(1);
        self.ends.extend(self.corners.drain(first..).rev());
        while let (Some(&from), Some(&to)) = (self.corners.last(), self.ends.last()) {
            match self.points.off_line(from, to, limit) {
                Some(at) => self.ends.push(at),
                None => {
                    self.ends.pop();
                    self.corners.push(to);
                }
            }
        }
    }

    /// Leaves out corners that lie on the line between their neighbours, but no two adjacent ones.
    /// The two points that the division began with need not be corners.
    fn drop_straight(&mut self, limit: f64) {
        let mut at = 0;
        while self.polygon.len() > 2 && at < self.polygon.len() {
            let last = self.polygon.len() - 1;
            let before = self.polygon[if at == 0 { last } else { at - 1 }];
            let (here, after) =
                (self.polygon[at], self.polygon[if at == last { 0 } else { at + 1 }]);
            let along = after - before;
            let off = f64::from(along.perp(&(here - before))).powi(2);
            let is_onwards = (here - before).dot(&(after - here)) >= 0;
            if is_onwards && off <= 0.5 * limit * f64::from(squared(along)) {
                self.polygon.remove(at);
            }
            at += 1;
        }
    }
}

/// Points, with all columns in one array and all rows in another.
#[derive(Debug, Default)]
struct OutlinePoints {
    columns: Vec<i32>,
    rows: Vec<i32>,
}

impl OutlinePoints {
    fn clear(&mut self) {
        self.columns.clear();
        self.rows.clear();
    }

    fn extend(&mut self, points: &[Pixel]) {
        self.columns.extend(points.iter().map(|point| point.x));
        self.rows.extend(points.iter().map(|point| point.y));
    }

    fn len(&self) -> usize {
        self.columns.len()
    }

    fn at(&self, index: usize) -> Pixel {
        Pixel::new(self.columns[index], self.rows[index])
    }

    /// Index of the point farthest from `point`; 0 if all are equal to it.
    fn farthest_from(&self, point: Pixel) -> usize {
        let distance = |other: Pixel| squared(other - point);
        self.farthest(0..self.len(), distance, |distance| distance > 0).unwrap_or(0)
    }

    /// Index of the point between two others that is farthest from their line, if its distance
    /// exceeds the root of `limit`.
    fn off_line(&self, from: usize, to: usize, limit: f64) -> Option<usize> {
        let start = self.at(from);
        let along = self.at(to) - start;
        if along == Pixel::zeros() {
            let off = |point: Pixel| squared(point - start);
            return self.farthest(from + 1..to, off, |off| f64::from(off) > limit);
        }
        // The distance from the line, times the line's length.
        let off = |point: Pixel| along.perp(&(point - start)).abs();
        let limit = limit * f64::from(squared(along));
        self.farthest(from + 1..to, off, |off| f64::from(off).powi(2) > limit)
    }

    /// Index of the first point among these whose distance is largest, if `is_far` holds for that.
    fn farthest(
        &self,
        among: Range<usize>,
        distance: impl Fn(Pixel) -> i32,
        is_far: impl Fn(i32) -> bool,
    ) -> Option<usize> {
        let (columns, rows) = (&self.columns[among.clone()], &self.rows[among.clone()]);
        let of = |(&column, &row): (&i32, &i32)| distance(Pixel::new(column, row));
        let (mut group, mut largest) = (0, 0);
        let groups = columns.chunks(GROUP).zip(rows.chunks(GROUP));
        for (index, (columns, rows)) in groups.enumerate() {
            let in_group = columns.iter().zip(rows).map(of).fold(0, i32::max);
            if in_group > largest {
                (group, largest) = (index * GROUP, in_group);
            }
        }
        if !is_far(largest) {
            return None;
        }
        let mut points = columns[group..].iter().zip(&rows[group..]);
        Some(among.start + group + points.position(|point| of(point) == largest)?)
    }
}

/// The squared length. Views are at most 4,096 pixels wide, so products of coordinates fit an
/// `i32`.
fn squared(a: Pixel) -> i32 {
    a.dot(&a)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use opencv::core::{Mat, Point, Vector};
    use opencv::imgproc::approx_poly_dp;
    use proptest::prelude::*;

    use super::*;

    fn approximate(outline: &[Pixel], accuracy_px: f64) -> Vec<Pixel> {
        let mut approximator = Approximator::default();
        // What is left in memory of another outline must not matter.
        approximator.set_outline(&[Pixel::new(9, 2), Pixel::new(5, 7)]);
        approximator.set_outline(outline);
        approximator.approximate(accuracy_px).to_vec()
    }

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

    /// The corners and the outline of a rotated square; the outline begins at pixel `first`.
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
        fn no_point_is_far_from_the_polygon(
            radii in prop::collection::vec(20.0..40.0f64, 12..80),
            accuracy_px in 1.0..6.0f64,
        ) {
            let step = std::f64::consts::TAU / radii.len() as f64;
            let pixel = |(k, radius): (usize, &f64)| {
                let (sine, cosine) = (step * k as f64).sin_cos();
                Pixel::new((radius * cosine).round() as i32, (radius * sine).round() as i32)
            };
            let outline: Vec<Pixel> = radii.iter().enumerate().map(pixel).collect();
            let polygon = approximate(&outline, accuracy_px);
            prop_assert!(polygon.iter().all(|corner| outline.contains(corner)));
            for &point in &outline {
                let off = from_polygon(point, &polygon);
                prop_assert!(off < 2.0 * accuracy_px, "{} off by {}", point, off);
            }
        }

        #[test]
        fn refining_a_rougher_polygon_gives_the_same_result(
            dice in prop::collection::vec(-3i32..=3, 8..200),
            rough_px in 2.0..12.0f64,
        ) {
            // A ragged outline that passes the same places repeatedly.
            let steps = dice.iter().zip(dice.iter().cycle().skip(3));
            let outline: Vec<Pixel> = steps
                .scan(Pixel::new(700, 700), |at, (&x, &y)| {
                    *at += Pixel::new(x, y);
                    Some(*at)
                })
                .collect();
            let mut approximator = Approximator::default();
            approximator.set_outline(&outline);
            approximator.approximate(rough_px);
            prop_assert_eq!(approximator.approximate(1.5), approximate(&outline, 1.5));
        }

        #[test]
        fn a_rough_square_has_four_corners_as_in_opencv(
            turn in 0.0..std::f64::consts::TAU,
            side in 16.0..60.0f64,
            first in 0usize..1000,
        ) {
            let (corners, outline) = square(side, turn, first);
            let accuracy_px = 0.05 * outline.len() as f64;
            let polygon = approximate(&outline, accuracy_px);
            prop_assert_eq!(polygon.len(), 4, "{:?}", polygon);
            // A corner may be some way along a side, by a share of the outline.
            let near_px = f64::max(3.0, 0.02 * outline.len() as f64);
            for [x, y] in corners {
                let near = |corner: &Pixel| (f64::from(corner.x) - x).hypot(f64::from(corner.y) - y);
                prop_assert!(polygon.iter().map(near).fold(f64::INFINITY, f64::min) < near_px);
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
                prop_assert!(polygon.iter().map(near).fold(f64::INFINITY, f64::min) < near_px);
            }
        }
    }

    #[test]
    fn outlines_of_one_point_or_none_are_kept() {
        assert!(approximate(&[], 1.0).is_empty());
        let point = [Pixel::new(3, 4)];
        assert_eq!(approximate(&point, 1.0), point);
    }

    /// A square at the end of a line of one pixel: the outline passes the line in both directions.
    #[test]
    fn a_square_at_the_end_of_a_line_is_kept() {
        let (_, square) = square(20.0, 0.0, 0);
        let neck = (0..30).map(|k| square[0] - Pixel::new(30 - k, 0));
        let back = neck.clone().rev();
        let outline: Vec<Pixel> = neck.chain(square.iter().copied()).chain(back).collect();
        let polygon = approximate(&outline, 2.0);
        assert!(outline.iter().all(|&point| from_polygon(point, &polygon) < 4.0), "{polygon:?}");
    }
}
