//! Consistency of errors with their covariances.

use flockeye_geometry::filter::chi_square_quantile;
use flockeye_geometry::statistics::{mean, median};
use nalgebra::{Matrix3, Matrix6, Vector3};
use serde::Serialize;

use super::error::{ErrorSample, PoseOffset};
use super::statistics::{effective_samples, effective_samples_of_runs};

/// Degrees of freedom of a position and of a rotation.
const DEGREES: f64 = 3.0;

/// Consistency of errors with their covariances.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum NeesVerdict {
    /// The mean lies within its bounds.
    Consistent,
    /// Errors are larger than the covariances state.
    Optimistic,
    /// Errors are smaller than the covariances state.
    Pessimistic,
}

/// Normalised estimation errors squared (NEES), e' P^-1 e, of positions or of rotations. For
/// correct covariances each is chi-square distributed with 3 degrees of freedom (Bar-Shalom, Li,
/// Kirubarajan, "Estimation with Applications to Tracking and Navigation", section 5.4.2).
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Nees {
    /// Number of samples.
    pub samples: usize,
    /// Effective number of independent samples.
    pub effective_samples: f64,
    /// Mean of the samples; 3 is expected.
    pub mean: f64,
    /// Median of the samples; 2.37 is expected. Outliers have no effect on it.
    pub median: f64,
    /// Share of samples within the 99 % ellipsoid.
    pub inside_99: f64,
    /// Lower bound of the mean (97.5 %) for correct covariances.
    pub low: f64,
    /// Upper bound of the mean (97.5 %) for correct covariances.
    pub high: f64,
    /// Position of the mean relative to its bounds.
    pub verdict: NeesVerdict,
}

impl Nees {
    /// Summarizes series of samples that are consecutive in time. Different series are independent.
    /// `None` without a sample.
    ///
    /// The sum of n independent samples is chi-square of 3 n degrees of freedom. Errors of
    /// consecutive frames are correlated, so n is their effective sample size
    /// ([`effective_samples`]).
    pub fn of(series: &[Vec<f64>]) -> Option<Self> {
        Self::with_effective(series, effective_samples(series))
    }

    /// NEES of independent runs ([`effective_samples_of_runs`]).
    pub fn of_runs(runs: &[Vec<f64>]) -> Option<Self> {
        Self::with_effective(runs, effective_samples_of_runs(runs))
    }

    fn with_effective(series: &[Vec<f64>], effective: f64) -> Option<Self> {
        let mut all = series.concat();
        all.sort_by(f64::total_cmp);
        let mean = mean(&all)?;
        let bound = |share: f64| chi_square_quantile(DEGREES * effective, share) / effective;
        let (low, high) = (bound(0.025), bound(0.975));
        let ellipsoid = chi_square_quantile(DEGREES, 0.99);
        let inside = all.iter().filter(|value| **value <= ellipsoid).count();
        Some(Self {
            samples: all.len(),
            effective_samples: effective,
            mean,
            median: median(&all)?,
            inside_99: inside as f64 / all.len() as f64,
            low,
            high,
            verdict: match mean {
                mean if mean > high => NeesVerdict::Optimistic,
                mean if mean < low => NeesVerdict::Pessimistic,
                _ => NeesVerdict::Consistent,
            },
        })
    }
}

/// NEES of positions and of rotations.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Consistency<N = Nees> {
    /// NEES of positions.
    pub position: N,
    /// NEES of rotations.
    pub rotation: N,
}

impl Consistency {
    /// NEES of series of errors with their covariances; `None` without a sample. A covariance that
    /// is not positive definite gives no sample.
    pub fn of(series: &[Vec<ErrorSample>]) -> Option<Self> {
        let nees = |error: fn(&PoseOffset) -> Vector3<f64>, first: usize| {
            let of_series = |series: &Vec<ErrorSample>| -> Vec<f64> {
                let block = |covariance: &Matrix6<f64>| {
                    covariance.fixed_view::<3, 3>(first, first).into_owned()
                };
                series.iter().filter_map(|(e, c)| normalised(&error(e), &block(c))).collect()
            };
            Nees::of(&series.iter().map(of_series).collect::<Vec<_>>())
        };
        Some(Self {
            position: nees(|error| error.position, 0)?,
            rotation: nees(|error| error.rotation, 3)?,
        })
    }
}

/// e' P^-1 e; `None` if the covariance is not positive definite.
pub fn normalised(error: &Vector3<f64>, covariance: &Matrix3<f64>) -> Option<f64> {
    Some(error.dot(&covariance.cholesky()?.solve(error)))
}

/// Cuts samples, each with its frame, into series of consecutive frames.
pub fn in_series<T>(samples: impl IntoIterator<Item = (u64, T)>) -> Vec<Vec<T>> {
    let mut series: Vec<Vec<T>> = Vec::new();
    let mut last = None;
    for (frame, sample) in samples {
        match series.last_mut() {
            Some(current) if last.is_some_and(|last: u64| last + 1 == frame) => {
                current.push(sample)
            }
            _ => series.push(vec![sample]),
        }
        last = Some(frame);
    }
    series
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::samples::truth_at;

    #[test]
    fn normalised_errors_are_those_computed_by_hand() {
        let covariance = Matrix3::new(4.0, 0.0, 0.0, 0.0, 2.0, 1.0, 0.0, 1.0, 2.0);
        // The inverse of the lower block is [2 -1; -1 2] / 3: 1 + (2 - 2 + 2) / 3 for (2, 1, 1).
        let found = normalised(&Vector3::new(2.0, 1.0, 1.0), &covariance).expect("a covariance");
        assert!((found - (1.0 + 2.0 / 3.0)).abs() < 1e-12, "{found}");
        assert_eq!(normalised(&Vector3::x(), &Matrix3::zeros()), None);
    }

    #[test]
    fn means_are_judged_by_their_bounds() {
        // Two independent samples of mean 3: chi-square of 6, by two: 1.2373 / 2 to 14.4494 / 2.
        let nees = Nees::of(&[vec![2.0], vec![4.0]]).expect("two");
        assert_eq!((nees.samples, nees.mean, nees.median), (2, 3.0, 3.0));
        assert!((nees.low - 0.618_67).abs() < 1e-4 && (nees.high - 7.224_7).abs() < 1e-4);
        assert_eq!(nees.verdict, NeesVerdict::Consistent);
        // The 99 % quantile of chi-square of 3 is 11.345.
        let inside = Nees::of(&[vec![11.3, 11.4, 2.0, 50.0]]).map(|nees| nees.inside_99);
        assert_eq!(inside, Some(0.5));
        let verdict =
            |values: [f64; 2]| Nees::of(&values.map(|x| vec![x])).map(|nees| nees.verdict);
        assert_eq!(verdict([9.0, 8.0]), Some(NeesVerdict::Optimistic));
        assert_eq!(verdict([0.1, 0.2]), Some(NeesVerdict::Pessimistic));
        assert_eq!(Nees::of(&[]), None);
    }

    #[test]
    fn position_and_rotation_have_their_own_blocks() {
        let truth = truth_at(0, Vector3::new(1.0, 0.0, 0.0));
        let turned = nalgebra::UnitQuaternion::from_euler_angles(0.02, 0.0, 0.0);
        let error = PoseOffset::of(&Vector3::new(1.01, 0.0, 0.0), &turned, &truth);
        let mut covariance = Matrix6::identity() * 1e-4;
        covariance[(0, 0)] = 4e-4;
        let found = Consistency::of(&[vec![(error, covariance)]]).expect("a sample");
        assert!((found.position.mean - 0.25).abs() < 1e-9, "{}", found.position.mean);
        assert!((found.rotation.mean - 4.0).abs() < 1e-9, "{}", found.rotation.mean);
        assert_eq!(Consistency::of(&[vec![(error, Matrix6::zeros())]]), None);
    }

    #[test]
    fn series_end_where_frames_are_missing() {
        let series = in_series([(3, 'a'), (4, 'b'), (6, 'c'), (7, 'd'), (9, 'e')]);
        assert_eq!(series, [vec!['a', 'b'], vec!['c', 'd'], vec!['e']]);
    }
}
