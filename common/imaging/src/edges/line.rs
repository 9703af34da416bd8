//! Lines through the positions of an edge in the profiles, and the corners where they cross.

use flockeye_geometry::view::ViewPixel;
use nalgebra::{Matrix2, Vector2};

use super::side::SideFrame;

/// Least standard deviation of a corner, pixels: the model of an edge is not perfect.
const MIN_SIGMA_PX: f64 = 0.03;

/// Largest median distance of the positions of an edge from their line, pixels.
const MAX_SCATTER_PX: f64 = 1.0;

/// Position of the edge in one profile.
#[derive(Debug, Clone, Copy)]
pub(super) struct EdgePoint {
    /// Position of the profile along the side: -1 at the first corner, 1 at the second.
    pub along: f64,
    /// Distance from the guessed side, inwards, pixels.
    pub depth: f64,
    /// Inverse variance, up to a factor that all positions share.
    pub weight: f64,
}

/// A line along a side. It lies `offset + slope * along` pixels inside the guessed side.
#[derive(Debug, Clone, Copy)]
pub(super) struct EdgeLine {
    offset: f64,
    slope: f64,
    covariance: Matrix2<f64>,
}

impl EdgeLine {
    /// A line parallel to the guess, `offset` pixels inside it, with a standard deviation of one
    /// pixel.
    pub(super) fn parallel(offset: f64) -> Self {
        Self { offset, slope: 0.0, covariance: Matrix2::from_diagonal_element(1.0) }
    }

    /// Returns this line with an additional error of its offset, standard deviation in pixels.
    pub(super) fn with_offset_error(mut self, sigma_px: f64) -> Self {
        self.covariance[(0, 0)] += sigma_px * sigma_px;
        self
    }

    fn depth(&self, along: f64) -> f64 {
        self.offset + self.slope * along
    }

    fn variance(&self, along: f64) -> f64 {
        let at = Vector2::new(1.0, along);
        (self.covariance * at).dot(&at)
    }
}

/// Fits a line by weighted least squares of the distances across the side. To first order in the
/// slope that is total least squares, because the guess is within a degree or two of the line.
///
/// Outliers are rejected by Tukey's weights, starting from a repeated median, which tolerates
/// nearly half of the positions being wrong. The covariance follows from the scatter and from the
/// correlation of neighbours. It is no smaller than `expected`, the covariance that the noise of
/// the samples explains.
///
/// `None` where fewer than four positions, or fewer than half of them, lie on a line.
pub(super) fn fit(places: &[EdgePoint], expected: Matrix2<f64>) -> Option<EdgeLine> {
    if places.len() < 4 {
        return None;
    }
    let start = repeated_median(places);
    let mut residuals: Vec<f64> = places.iter().map(|place| distance(place, start)).collect();
    let mut robust = tukey(&residuals);
    let mut found = (start, Matrix2::zeros());
    for _ in 0..4 {
        let (mut normal, mut right) = (Matrix2::zeros(), Vector2::zeros());
        for (place, robust) in places.iter().zip(&robust) {
            let row = Vector2::new(1.0, place.along);
            normal += row * row.transpose() * (place.weight * robust);
            right += row * (place.weight * robust * place.depth);
        }
        let inverse = normal.try_inverse()?;
        let line = inverse * right;
        found = (line, inverse);
        residuals = places.iter().map(|place| distance(place, line)).collect();
        robust = tukey(&residuals);
    }
    let scatter = median(residuals.iter().map(|residual| residual.abs()).collect());
    let agreeing = robust.iter().filter(|&&robust| robust > 0.2).count();
    if scatter > MAX_SCATTER_PX || agreeing < 4 || 2 * agreeing < places.len() {
        return None;
    }
    let ([offset, slope], inverse) = (found.0.into(), found.1);
    let weights: Vec<f64> =
        places.iter().zip(&robust).map(|(place, robust)| place.weight * robust).collect();
    let freedom = robust.iter().sum::<f64>() - 2.0;
    let squares: f64 = weights.iter().zip(&residuals).map(|(w, r)| w * r * r).sum();
    let scattered =
        inverse * (squares / freedom.max(1.0) * residual_correlation(&weights, &residuals));
    let covariance = if scattered.trace() > expected.trace() { scattered } else { expected };
    Some(EdgeLine { offset, slope, covariance })
}

/// Distance of a position from the line with this offset and slope.
fn distance(place: &EdgePoint, line: Vector2<f64>) -> f64 {
    place.depth - line[0] - line[1] * place.along
}

/// Tukey's weights: 1 on the line, 0 beyond 4.7 robust standard deviations.
fn tukey(residuals: &[f64]) -> Vec<f64> {
    let scale = (1.4826 * median(residuals.iter().map(|r| r.abs()).collect())).max(MIN_SIGMA_PX);
    let weight = |residual: &f64| {
        let share = residual / (4.7 * scale);
        if share.abs() < 1.0 { (1.0 - share * share).powi(2) } else { 0.0 }
    };
    residuals.iter().map(weight).collect()
}

/// Offset and slope of the repeated median line, which is robust to nearly half of the positions
/// (A. Siegel, Robust regression using repeated medians, Biometrika 69, 1982).
fn repeated_median(places: &[EdgePoint]) -> Vector2<f64> {
    let slopes = places.iter().map(|from| {
        let others = places.iter().filter(|to| (to.along - from.along).abs() > 1e-9);
        median(others.map(|to| (to.depth - from.depth) / (to.along - from.along)).collect())
    });
    let slope = median(slopes.collect());
    let offset = median(places.iter().map(|place| place.depth - slope * place.along).collect());
    Vector2::new(offset, slope)
}

/// The median; 0 without values.
fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}

/// Variance of a mean relative to that of independent residuals: (1 + r)/(1 - r) for a first-order
/// autocorrelation r.
fn residual_correlation(weights: &[f64], residuals: &[f64]) -> f64 {
    let size = |k: usize| weights[k].sqrt() * residuals[k];
    let squares: f64 = (0..residuals.len()).map(|k| size(k).powi(2)).sum();
    let products: f64 = (1..residuals.len()).map(|k| size(k - 1) * size(k)).sum();
    let r = (products / squares.max(1e-12)).clamp(0.0, 0.7);
    (1.0 + r) / (1.0 - r)
}

/// Intersection of the lines of two neighbouring sides, with its standard deviation along each
/// axis, pixels. `None` where they are nearly parallel.
pub(super) fn cross(
    before: (&SideFrame, &EdgeLine),
    after: (&SideFrame, &EdgeLine),
) -> Option<(ViewPixel, f64)> {
    let (from, along) = ends(before);
    let (start, other) = ends(after);
    let determinant = along.perp(&other);
    if determinant.abs() < 0.05 * along.norm() * other.norm() {
        return None;
    }
    let at = from + along * ((start - from).perp(&other) / determinant);
    // Shifting one line sideways moves the corner along the other line.
    let sine = determinant / (along.norm() * other.norm());
    let variance = (before.1.variance(1.0) + after.1.variance(-1.0)) / (2.0 * sine * sine);
    Some((ViewPixel(at), variance.sqrt().hypot(MIN_SIGMA_PX)))
}

/// The line's point next to the side's first corner, and the vector from there to the point next to
/// the second corner.
fn ends((side, line): (&SideFrame, &EdgeLine)) -> (Vector2<f64>, Vector2<f64>) {
    let at = |along: f64| {
        side.middle + side.along * (side.half * along) + side.inward * line.depth(along)
    };
    (at(-1.0), at(1.0) - at(-1.0))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    fn place(along: f64, depth: f64) -> EdgePoint {
        EdgePoint { along, depth, weight: 1.0 }
    }

    #[test]
    fn an_occluded_third_of_a_side_is_rejected() {
        let places: Vec<EdgePoint> = (0..15)
            .map(|k| {
                let along = f64::from(k) / 7.0 - 1.0;
                let scatter = 0.02 * f64::from(k * 7 % 5 - 2);
                let occluded = if k < 5 { 1.5 } else { 0.0 };
                place(along, 0.3 - 0.2 * along + scatter + occluded)
            })
            .collect();
        let line = fit(&places, Matrix2::zeros()).unwrap();
        assert!((line.depth(1.0) - 0.1).abs() < 0.06, "{line:?}");
        assert!((line.depth(-1.0) - 0.5).abs() < 0.12, "{line:?}");
    }

    #[test]
    fn positions_that_lie_on_no_line_are_refused() {
        let depths = [0.0, 4.0, -5.0, 3.0, -4.0, 6.0, -7.0, 2.0];
        let places: Vec<EdgePoint> =
            (0u8..).zip(depths).map(|(k, depth)| place(f64::from(k) / 3.5 - 1.0, depth)).collect();
        assert!(fit(&places, Matrix2::identity()).is_none());
        assert!(fit(&places[..3], Matrix2::identity()).is_none());
    }

    #[test]
    fn lines_cross_at_the_corner() {
        let side = |middle: (f64, f64), along: Vector2<f64>| SideFrame {
            middle: Vector2::new(middle.0, middle.1),
            along,
            inward: Vector2::new(-along.y, along.x),
            half: 5.0,
        };
        let left = side((0.0, 5.0), -Vector2::y());
        let top = side((5.0, 0.0), Vector2::x());
        let (corner, sigma_px) =
            cross((&left, &EdgeLine::parallel(0.25)), (&top, &EdgeLine::parallel(-0.5))).unwrap();
        assert!((corner.0 - Vector2::new(0.25, -0.5)).norm() < 1e-12);
        assert!((sigma_px - 2f64.sqrt()).abs() < 1e-3, "{sigma_px}");
        assert!(
            cross((&left, &EdgeLine::parallel(0.0)), (&left, &EdgeLine::parallel(1.0))).is_none()
        );
    }
}
