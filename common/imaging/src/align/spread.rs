//! The point spread of a moving body: the lens's, and the even blur along the body's path.
//!
//! A short path of length d blurs along itself like a Gaussian of variance d² / 12. The unknowns are
//! then the three elements of one covariance. A long path has a shape of its own. It is modelled in
//! equal parts, each a Gaussian: the lens's, wider along the path by the part's own variance. The
//! path is fitted, because track and gyroscope know it to some per cent only. Such an error turns
//! the body by several standard deviations (docs/results/constants.md#motion-blur).

use nalgebra::{Matrix2, Vector2};

/// Longest part of a path that is modelled by one Gaussian, standard deviations of the lens's point
/// spread.
///
/// The profile of an edge is then off by at most 0.4 % of its contrast
/// (docs/results/constants.md#motion-blur).
const PART_BLURS: f64 = 3.0;
/// Most parts of a path. Longer paths have longer parts.
const MAX_PARTS: f64 = 8.0;
/// Standard deviation of a path from track and gyroscope, as a share of it, along and across.
const PATH_UNCERTAINTY: f64 = 0.1;
/// Standard deviation of the lens's variance, as a share of it.
const LENS_UNCERTAINTY: f64 = 0.5;
/// Longest path, in standard deviations of the lens's point spread, for which a Gaussian is a good
/// model.
const LONG_PATH_BLURS: f64 = 2.0;
/// Narrowest and widest standard deviation of the Gaussian, pixels.
const LIMITS_PX: (f64, f64) = (0.35, 6.0);

/// A point spread in the pixels of a patch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Spread {
    /// Motion of the body during the exposure, pixels. Zero if it is not known, or so short that
    /// `gaussian` contains it.
    pub path_px: Vector2<f64>,
    /// Number of the path's parts; 1 without a path.
    pub parts: u8,
    /// Covariance of the point spread without `path_px`, pixels squared.
    pub gaussian: Matrix2<f64>,
}

impl Spread {
    /// The expected point spread of a body that moves by `path_px` during the exposure, and the
    /// standard deviations of its unknowns. `lens_px` is the lens's standard deviation.
    pub(super) fn expected(lens_px: f64, path_px: Vector2<f64>) -> (Self, [f64; 3]) {
        let lens = Matrix2::identity() * lens_px.powi(2);
        let of_lens = LENS_UNCERTAINTY * lens_px.powi(2);
        if path_px.norm() > LONG_PATH_BLURS * lens_px {
            let parts = (path_px.norm() / (PART_BLURS * lens_px)).ceil().clamp(2.0, MAX_PARTS);
            let of_path = PATH_UNCERTAINTY * path_px.norm();
            let spread = Self { path_px, parts: parts as u8, gaussian: lens };
            return (spread, [of_path, of_path, of_lens]);
        }
        let gaussian = lens + path_px * path_px.transpose() / 12.0;
        let of_path = PATH_UNCERTAINTY * path_px.norm_squared() / 12.0;
        (Self { path_px: Vector2::zeros(), parts: 1, gaussian }, [of_lens.hypot(of_path); 3])
    }

    /// Whether the path is modelled by itself.
    #[inline]
    pub(super) fn has_path(&self) -> bool {
        self.parts > 1
    }

    /// Variance of an even blur along one part, as a share of the squared path.
    fn part_variance(&self) -> f64 {
        1.0 / (12.0 * f64::from(self.parts).powi(2))
    }

    /// The unknowns: the path and the Gaussian's variance, or else its covariance (xx, xy, yy).
    pub(super) fn unknowns(&self) -> [f64; 3] {
        let Self { path_px, gaussian, .. } = self;
        match self.has_path() {
            true => [path_px.x, path_px.y, gaussian[(0, 0)]],
            false => [gaussian[(0, 0)], gaussian[(0, 1)], gaussian[(1, 1)]],
        }
    }

    /// Derivatives of a pixel by the unknowns. `curvature` is the second derivative of its radiance
    /// by the position, `by_path` its derivative by the path where the Gaussians are fixed.
    #[inline(always)]
    pub(super) fn derivatives(&self, curvature: &Matrix2<f64>, by_path: &Vector2<f64>) -> [f64; 3] {
        // The heat equation: adding to a Gaussian's covariance adds half the curvature.
        if self.has_path() {
            let by_path = by_path + curvature * self.path_px * self.part_variance();
            [by_path.x, by_path.y, curvature.trace() / 2.0]
        } else {
            [curvature[(0, 0)] / 2.0, curvature[(0, 1)], curvature[(1, 1)] / 2.0]
        }
    }

    /// Adds a step of the unknowns.
    pub(super) fn add(&mut self, step: [f64; 3]) {
        let [first, second, third] = step;
        if self.has_path() {
            self.path_px += Vector2::new(first, second);
            self.gaussian += Matrix2::identity() * third;
        } else {
            self.gaussian += Matrix2::new(first, second, second, third);
        }
        self.limit();
    }

    /// Limits the standard deviations of the Gaussian and the length of the path.
    pub(super) fn limit(&mut self) {
        let (least, most) = LIMITS_PX;
        let longest_px = f64::from(self.parts) * PART_BLURS * most;
        self.path_px = self.path_px.cap_magnitude(longest_px);
        let mut axes = self.gaussian.symmetric_eigen();
        axes.eigenvalues.apply(|value| *value = value.clamp(least.powi(2), most.powi(2)));
        self.gaussian = axes.recompose();
    }

    /// Covariance of the Gaussian of each part, pixels squared.
    pub(super) fn of_part(&self) -> Matrix2<f64> {
        self.gaussian + self.path_px * self.path_px.transpose() * self.part_variance()
    }

    /// Covariance of the whole point spread, pixels squared.
    pub(super) fn whole(&self) -> Matrix2<f64> {
        self.gaussian + self.path_px * self.path_px.transpose() / 12.0
    }
}

/// Middles of a path's equal parts, as shares of the path from its middle.
#[inline(always)]
pub(super) fn middles(parts: u8) -> impl Iterator<Item = f32> {
    let per_path = 1.0 / f32::from(parts);
    (0..parts).map(move |part| (f32::from(part) + 0.5) * per_path - 0.5)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_of_a_path_have_its_variance() {
        for (px, parts) in [(3.0, 2), (8.0, 3), (11.5, 4), (99.0, 8)] {
            let (spread, _) = Spread::expected(1.0, Vector2::new(0.0, px));
            assert_eq!(spread.parts, parts);
            let squares = middles(parts).map(|at| f64::from(at).powi(2) * px * px);
            let of_middles = squares.sum::<f64>() / f64::from(parts);
            let together = of_middles + spread.of_part()[(1, 1)];
            assert!((together - spread.whole()[(1, 1)]).abs() < 1e-3, "{px}: {together}");
        }
    }

    #[test]
    fn steps_change_the_unknowns_of_a_short_and_of_a_long_path() {
        for path in [Vector2::new(0.5, 0.2), Vector2::new(6.0, -3.0)] {
            let (mut spread, _) = Spread::expected(1.0, path);
            let before = spread.unknowns();
            spread.add([0.2, 0.1, 0.3]);
            let after = spread.unknowns();
            for (k, step) in [0.2, 0.1, 0.3].into_iter().enumerate() {
                assert!((after[k] - before[k] - step).abs() < 1e-9, "{path:?}: {after:?}");
            }
            spread.add([0.0, 0.0, -20.0]);
            assert!(spread.gaussian.symmetric_eigen().eigenvalues.min() > 0.12, "{spread:?}");
            spread.add([1e9, 0.0, 0.0]);
            assert!(spread.path_px.norm() < 100.0, "{spread:?}");
        }
    }
}
