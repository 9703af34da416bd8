//! Which of several solutions is meant.

use nalgebra::{Isometry3, Matrix6, Vector6};

use super::PoseSolution;

/// What is known of a pose before it is measured, as a track's prediction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PosePrior {
    /// The predicted pose of the body's markers in the camera frame.
    pub camera_from_markers: Isometry3<f64>,
    /// Its covariance: position (m), then rotation vector (rad), in the camera frame's axes.
    pub covariance: Matrix6<f64>,
}

/// The best of several solutions.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Choice<'a> {
    /// The solution.
    pub solution: &'a PoseSolution,
    /// Its cost over the runner-up's, the prior's share in both: near 1 if it might as well be the
    /// other, 0 if there is no other.
    pub cost_ratio: f64,
    /// The runner-up's cost less its own: twice the logarithm of their likelihoods' ratio. Infinite
    /// if there is no other.
    pub cost_margin: f64,
}

/// A prior never weighs more than about this many squared standard deviations for each factor of e
/// by which it is exceeded, so that a wrong track can be contradicted: the 99.9 % quantile of
/// chi-square with 6 degrees of freedom.
const PRIOR_SCALE: f64 = 22.46;

/// The cheapest solution, its distance from the prior counted in; `None` if there is none.
pub fn choose<'a>(
    solutions: &'a [PoseSolution],
    predicted: Option<&PosePrior>,
) -> Option<Choice<'a>> {
    let mut ranked: Vec<(f64, &PoseSolution)> = solutions
        .iter()
        .map(|solution| {
            let prior = predicted.map_or(0.0, |prior| prior_cost(solution, prior));
            (solution.cost + prior, solution)
        })
        .collect();
    ranked.sort_by(|a, b| a.0.total_cmp(&b.0));
    let &(cost, solution) = ranked.first()?;
    let (cost_ratio, cost_margin) = match ranked.get(1) {
        Some(&(other, _)) if other > 0.0 => (cost / other, other - cost),
        Some(_) => (1.0, 0.0),
        None => (0.0, f64::INFINITY),
    };
    Some(Choice { solution, cost_ratio, cost_margin })
}

/// Robust squared Mahalanobis distance between a solution and a prior.
fn prior_cost(solution: &PoseSolution, prior: &PosePrior) -> f64 {
    let (found, expected) = (&solution.camera_from_markers, &prior.camera_from_markers);
    let mut difference = Vector6::zeros();
    difference
        .fixed_rows_mut::<3>(0)
        .copy_from(&(found.translation.vector - expected.translation.vector));
    difference
        .fixed_rows_mut::<3>(3)
        .copy_from(&(found.rotation * expected.rotation.inverse()).scaled_axis());
    let covariance = prior.covariance + solution.inflated_covariance();
    // A covariance that is none says nothing.
    let squared =
        covariance.cholesky().map_or(0.0, |factor| difference.dot(&factor.solve(&difference)));
    PRIOR_SCALE * (squared.max(0.0) / PRIOR_SCALE).ln_1p()
}
