//! The choice between several solutions.

use super::{PoseEstimate, PoseSolution, is_false, pose_difference};

/// Limit on the weight of a prior, so that measurements can contradict a wrong track: about this
/// many squared standard deviations for each factor of e beyond it. It is the 99.9 % quantile of
/// chi-square with 6 degrees of freedom.
const PRIOR_SCALE: f64 = 22.46;

/// Most false poses of a target (by 10 cm or 10 degrees) in an hour, for each way to find one.
pub const FALSE_POSES_PER_HOUR: f64 = 1.0;

/// Choices between several poses in an hour, assumed: a body is found anew each half minute.
const CHOICES_PER_HOUR: f64 = 120.0;

/// Least lead of a chosen pose: its log odds less those of all others together.
pub fn least_lead() -> f64 {
    (CHOICES_PER_HOUR / FALSE_POSES_PER_HOUR).ln()
}

/// The cheapest solution, including its distance from the prior; `None` without solutions.
pub fn choose<'a>(
    solutions: &'a [PoseSolution],
    predicted: Option<&PoseEstimate>,
) -> Option<&'a PoseSolution> {
    ranked(solutions, predicted).first().map(|&(_, solution)| solution)
}

/// Log odds of the solution `one` against all others together that would be false if it is true.
/// Infinite without such others. Where its rays scatter more than stated, their costs count less.
pub fn lead(
    solutions: &[PoseSolution],
    one: &PoseSolution,
    predicted: Option<&PoseEstimate>,
) -> f64 {
    let scatter = one.reduced_chi_square.max(1.0);
    let cost = |solution: &PoseSolution| solution.cost / scatter + prior_cost(solution, predicted);
    let rivals = solutions
        .iter()
        .filter(|other| is_false(&other.camera_from_markers, &one.camera_from_markers));
    let together: f64 = rivals.map(|rival| (0.5 * (cost(one) - cost(rival))).exp()).sum();
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
        .map(|solution| (solution.cost + prior_cost(solution, predicted), solution))
        .collect();
    ranked.sort_by(|a, b| a.0.total_cmp(&b.0));
    ranked
}

/// Robust squared Mahalanobis distance between a solution and a prior; 0 without a prior.
fn prior_cost(solution: &PoseSolution, predicted: Option<&PoseEstimate>) -> f64 {
    let Some(prior) = predicted else { return 0.0 };
    let difference = pose_difference(&solution.camera_from_markers, &prior.camera_from_markers);
    let covariance = prior.covariance + solution.inflated_covariance();
    // A matrix that is no covariance has no weight.
    let squared =
        covariance.cholesky().map_or(0.0, |factor| difference.dot(&factor.solve(&difference)));
    PRIOR_SCALE * (squared.max(0.0) / PRIOR_SCALE).ln_1p()
}
