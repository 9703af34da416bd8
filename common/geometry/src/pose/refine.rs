//! Refinement of a pose on its rays: Levenberg-Marquardt over position and rotation.

use nalgebra::{Isometry3, Matrix6};

use super::rays::{Sight, SightedMarker};
use super::residual::{
    Fitting, cauchy, cost, error, error_and_jacobian, facing, fitting, is_agreeing, moved, normal,
};
use super::{GATE_DEVIATIONS, PoseSolution, ROBUST_SCALE};

/// Share of a marker's side up to which errors count fully for an inexact start.
const COARSE_SIDE: f64 = 0.2;
/// Share of a marker's side beyond which errors exclude a marker from the coarse fit.
const COARSE_GATE: f64 = 0.6;

/// Refines first on all rays that roughly fit; errors up to a fifth of a side count fully. Then
/// refines on the fitting rays, until these no longer change.
pub(super) fn refine_sighted(
    markers: &[SightedMarker<'_>],
    start: &Isometry3<f64>,
) -> Option<PoseSolution> {
    let roughly: Vec<Fitting> = markers.iter().map(|marker| roughly_fits(marker, start)).collect();
    let mut pose = *start;
    if count(markers, &roughly) >= 4 {
        pose = minimise(markers, &roughly, &pose, 8, |sight| {
            (COARSE_SIDE * sight.side).max(ROBUST_SCALE)
        })?;
    }
    let mut inliers: Vec<Fitting> =
        markers.iter().map(|marker| fitting(marker, &pose, |sight| sight.gate)).collect();
    for _ in 0..5 {
        if count(markers, &inliers) < 4 {
            return None;
        }
        pose = minimise(markers, &inliers, &pose, 30, |_| ROBUST_SCALE)?;
        let gate = GATE_DEVIATIONS * scatter(markers, &inliers, &pose);
        let now: Vec<Fitting> = markers
            .iter()
            .map(|marker| fitting(marker, &pose, |sight| sight.gate.min(gate)))
            .collect();
        if now == inliers {
            break;
        }
        inliers = now;
    }
    solution(markers, &inliers, pose)
}

/// Scatter of these rays' errors, in stated deviations, at least one. Half of the errors of a
/// Gaussian in two dimensions are below 1.18 deviations.
fn scatter(markers: &[SightedMarker<'_>], inliers: &[Fitting], pose: &Isometry3<f64>) -> f64 {
    let mut errors: Vec<f64> = chosen_sights(markers, inliers)
        .filter_map(|sight| error(sight, pose))
        .map(|error| error.norm())
        .collect();
    errors.sort_by(f64::total_cmp);
    // A pose adapts to few rays, so their residuals are smaller than their errors.
    let count = errors.len() as f64;
    let bent = (2.0 * count / (2.0 * count - 6.0).max(2.0)).sqrt();
    errors.get(errors.len() / 2).map_or(1.0, |error| (error / 1.177 * bent).max(1.0))
}

/// Robust cost of all rays at a pose, in squared standard deviations. Rays that do not fit cost as
/// much as at their gates.
pub(super) fn consensus_cost(markers: &[SightedMarker<'_>], pose: &Isometry3<f64>) -> f64 {
    let of_marker = |marker: &SightedMarker<'_>| -> f64 {
        let fitting = fitting(marker, pose, |sight| sight.gate);
        let of_sight = |(sight, fits): (&Sight, bool)| match error(sight, pose) {
            Some(error) if fits => cauchy(error.norm_squared(), ROBUST_SCALE),
            _ => cauchy(sight.gate * sight.gate, ROBUST_SCALE),
        };
        marker.sights.iter().zip(fitting).map(of_sight).sum()
    };
    markers.iter().map(of_marker).sum()
}

/// Misfit of a rough pose, from 0 to 1 for each ray. Errors are relative to the markers' sides,
/// because a hypothesis from one marker has errors beyond the noise on the others.
pub(super) fn rough_cost(markers: &[SightedMarker<'_>], pose: &Isometry3<f64>) -> f64 {
    markers
        .iter()
        .map(|marker| {
            if facing(marker, pose) < -0.2 {
                return marker.sights.len() as f64;
            }
            let share = |sight: &Sight| {
                error(sight, pose).map_or(1.0, |error| {
                    let squared = error.norm_squared() / (COARSE_SIDE * sight.side).powi(2);
                    squared / (1.0 + squared)
                })
            };
            marker.sights.iter().map(share).sum()
        })
        .sum()
}

fn roughly_fits(marker: &SightedMarker<'_>, pose: &Isometry3<f64>) -> Fitting {
    let mut roughly = [false; 4];
    if facing(marker, pose) > -0.2 {
        for (fits, sight) in roughly.iter_mut().zip(&marker.sights) {
            *fits = error(sight, pose).is_some_and(|error| error.norm() < COARSE_GATE * sight.side);
        }
    }
    if is_agreeing(marker, &roughly) { roughly } else { [false; 4] }
}

fn count(markers: &[SightedMarker<'_>], chosen: &[Fitting]) -> usize {
    chosen_sights(markers, chosen).count()
}

fn chosen_sights<'a>(
    markers: &'a [SightedMarker<'_>],
    chosen: &'a [Fitting],
) -> impl Iterator<Item = &'a Sight> + Clone {
    let pairs = markers
        .iter()
        .zip(chosen)
        .flat_map(|(marker, fitting)| marker.sights.iter().zip(fitting).filter(|&(_, &fits)| fits));
    pairs.map(|(sight, _)| sight)
}

/// Levenberg-Marquardt (Marquardt's scaling by the diagonal) on the robust cost of the chosen rays.
fn minimise(
    markers: &[SightedMarker<'_>],
    chosen: &[Fitting],
    start: &Isometry3<f64>,
    iterations: usize,
    scale: impl Fn(&Sight) -> f64 + Copy,
) -> Option<Isometry3<f64>> {
    let sights = chosen_sights(markers, chosen);
    let mut pose = *start;
    let mut damping = 1e-4;
    let mut at = normal(sights.clone(), &pose, scale)?;
    for _ in 0..iterations {
        let mut damped = at.matrix;
        for k in 0..6 {
            // The lower limit keeps a direction without information from being singular.
            damped[(k, k)] += damping * at.matrix[(k, k)].max(1e-9);
        }
        let Some(factor) = damped.cholesky() else {
            damping *= 10.0;
            continue;
        };
        let step = -factor.solve(&at.gradient);
        let next = moved(&pose, &step);
        let next_cost = cost(sights.clone(), &next, scale);
        if next_cost <= at.cost {
            let gained = at.cost - next_cost;
            pose = next;
            damping = (damping * 0.1).max(1e-12);
            at = normal(sights.clone(), &pose, scale)?;
            if gained < 1e-9 * (1.0 + at.cost) {
                break;
            }
        } else {
            damping *= 10.0;
            if damping > 1e8 {
                break;
            }
        }
    }
    Some(pose)
}

/// Statistics of a refined pose; `None` if no marker fits or the rays do not determine the pose.
fn solution(
    markers: &[SightedMarker<'_>],
    inliers: &[Fitting],
    pose: Isometry3<f64>,
) -> Option<PoseSolution> {
    let sights = chosen_sights(markers, inliers);
    let inlier_corners = sights.clone().count();
    if inlier_corners < 4 {
        return None;
    }
    // At least four rays, which leave two degrees of freedom.
    let freedom = (2 * inlier_corners - 6) as f64;
    // A pose adapts to its rays, so their weighted residuals are smaller than their errors.
    let bent = (freedom / (2 * inlier_corners) as f64).sqrt();
    let covariance = covariance(sights.clone(), &pose, ROBUST_SCALE / bent)?;
    if !covariance.iter().chain(pose.translation.vector.iter()).all(|x| x.is_finite()) {
        return None;
    }
    let squares: f64 =
        sights.filter_map(|sight| error(sight, &pose)).map(|error| error.norm_squared()).sum();
    let agreeing =
        markers.iter().zip(inliers).filter(|(marker, fitting)| is_agreeing(marker, fitting));
    Some(PoseSolution {
        camera_from_markers: pose,
        covariance,
        cost: consensus_cost(markers, &pose),
        reduced_chi_square: squares / freedom,
        inlier_markers: agreeing.map(|(marker, _)| marker.marker.id).collect(),
        inlier_corners,
    })
}

/// Covariance of the pose that minimises the robust cost of these rays, if their errors are
/// Gaussian as stated: `(J^T J)^-1` times the loss from the weights (P. Huber, Robust Statistics,
/// 1981, 6.3), the mean of the squared influence over the squared mean of its slope.
fn covariance<'a>(
    sights: impl Iterator<Item = &'a Sight>,
    pose: &Isometry3<f64>,
    scale: f64,
) -> Option<Matrix6<f64>> {
    let mut matrix = Matrix6::zeros();
    for sight in sights {
        let (_, jacobian) = error_and_jacobian(sight, pose)?;
        matrix += jacobian.transpose() * jacobian;
    }
    Some(matrix.cholesky()?.inverse() * loss(scale))
}

/// Loss of efficiency of Cauchy's cost of this scale against least squares, for errors in two
/// dimensions with a deviation of one: 1.03 for a scale of 3.
fn loss(scale: f64) -> f64 {
    const PARTS: u32 = 64;
    let (mut influence, mut slope) = (0.0, 0.0);
    for part in 0..PARTS {
        // The squared error has an exponential distribution with a mean of 2.
        let below = (f64::from(part) + 0.5) / f64::from(PARTS);
        let squared = -2.0 * (1.0 - below).ln();
        let weight = 1.0 / (1.0 + squared / (scale * scale));
        influence += weight * weight * squared / 2.0;
        slope += weight - weight * weight * squared / (scale * scale);
    }
    influence * f64::from(PARTS) / (slope * slope)
}
