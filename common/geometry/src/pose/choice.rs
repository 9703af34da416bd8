//! The choice between several solutions.

use super::{PoseEstimate, PoseSolution, is_false, pose_difference};

/// Limit on the weight of a prior, so that measurements can contradict a wrong track: about this
/// many squared standard deviations for each factor of e beyond it. It is the 99.9 % quantile of
/// chi-square with 6 degrees of freedom.
const PRIOR_SCALE: f64 = 22.46;

/// The cheapest solution, including its distance from the prior; `None` without solutions.
pub fn choose<'a>(
    solutions: &'a [PoseSolution],
    predicted: Option<&PoseEstimate>,
) -> Option<&'a PoseSolution> {
    ranked(solutions, predicted).first().map(|&(_, solution)| solution)
}

/// Log odds of the `chosen` solution against all others together that would be false if it is true.
/// Infinite without such others. Where its rays scatter more than stated, costs count less.
pub fn lead(
    solutions: &[PoseSolution],
    chosen: &PoseSolution,
    predicted: Option<&PoseEstimate>,
) -> f64 {
    let cost = |solution: &PoseSolution| {
        let prior = predicted.map_or(0.0, |prior| prior_cost(solution, prior));
        solution.cost / chosen.reduced_chi_square.max(1.0) + prior
    };
    let others = solutions
        .iter()
        .filter(|solution| is_false(&solution.camera_from_markers, &chosen.camera_from_markers));
    let together: f64 = others.map(|other| (0.5 * (cost(chosen) - cost(other))).exp()).sum();
    -together.ln()
}

/// The solutions with their costs, including their distances from the prior; the cheapest comes
/// first. The difference of two costs is twice the log-likelihood ratio.
pub(super) fn ranked<'a>(
    solutions: &'a [PoseSolution],
    predicted: Option<&PoseEstimate>,
) -> Vec<(f64, &'a PoseSolution)> {
    let mut ranked: Vec<(f64, &PoseSolution)> = solutions
        .iter()
        .map(|solution| {
            let prior = predicted.map_or(0.0, |prior| prior_cost(solution, prior));
            (solution.cost + prior, solution)
        })
        .collect();
    ranked.sort_by(|a, b| a.0.total_cmp(&b.0));
    ranked
}

/// Robust squared Mahalanobis distance between a solution and a prior.
fn prior_cost(solution: &PoseSolution, prior: &PoseEstimate) -> f64 {
    let difference = pose_difference(&solution.camera_from_markers, &prior.camera_from_markers);
    let covariance = prior.covariance + solution.inflated_covariance();
    // A matrix that is no covariance has no weight.
    let squared =
        covariance.cholesky().map_or(0.0, |factor| difference.dot(&factor.solve(&difference)));
    PRIOR_SCALE * (squared.max(0.0) / PRIOR_SCALE).ln_1p()
}
