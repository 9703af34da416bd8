//! A pose made to fit its rays: Levenberg-Marquardt over position and rotation.

use nalgebra::{Isometry3, Matrix6};

use super::rays::{CornerRay, Sight, SightedMarker, sighted};
use super::residual::{cauchy, cost, error, facing, fits, moved, normal};
use super::{PoseError, PoseOptions, PoseSolution};
use crate::body::Body;

/// Share of a marker's side up to which errors count fully while a start may still be off.
const COARSE_SIDE: f64 = 0.2;
/// Errors beyond this share of a marker's side keep it out of the coarse fit.
const COARSE_GATE: f64 = 0.6;

/// Refines a pose that is roughly known, as from a track, on the rays of `body`.
///
/// Unlike [`super::solve`] it needs no whole marker, and it follows one branch of the solution only:
/// that of `start`.
///
/// # Errors
/// Fewer than four usable rays, or no marker that fits its rays and faces the camera.
pub fn refine(
    body: &Body,
    rays: &[CornerRay],
    start: &Isometry3<f64>,
    options: &PoseOptions,
) -> Result<PoseSolution, PoseError> {
    let markers = sighted(body, rays, options);
    let usable = markers.iter().map(|marker| marker.sights.len()).sum();
    if usable < 4 {
        return Err(PoseError::TooFewRays { usable, given: rays.len() });
    }
    refine_sighted(&markers, start, options)
        .ok_or(PoseError::NothingFits { markers: markers.len() })
}

/// First on all markers that roughly agree, errors within a fifth of a side counting fully; then on
/// those that fit, until these stay the same.
pub(super) fn refine_sighted(
    markers: &[SightedMarker<'_>],
    start: &Isometry3<f64>,
    options: &PoseOptions,
) -> Option<PoseSolution> {
    let roughly: Vec<bool> = markers.iter().map(|marker| roughly_fits(marker, start)).collect();
    let mut pose = *start;
    if count(markers, &roughly) >= 4 {
        pose = minimise(markers, &roughly, &pose, 8, |sight| {
            (COARSE_SIDE * sight.side).max(options.robust_scale)
        })?;
    }
    let fitting = |pose: &Isometry3<f64>| -> Vec<bool> {
        markers.iter().map(|marker| fits(marker, pose)).collect()
    };
    let mut inliers = fitting(&pose);
    for _ in 0..4 {
        if count(markers, &inliers) < 4 {
            return None;
        }
        pose = minimise(markers, &inliers, &pose, 30, |_| options.robust_scale)?;
        let now = fitting(&pose);
        if now == inliers {
            break;
        }
        inliers = now;
    }
    solution(markers, &inliers, pose, options)
}

/// Robust cost of all rays at a pose, in squared standard deviations: those of a marker that does
/// not fit cost as much as at their gates.
pub(super) fn consensus_cost(
    markers: &[SightedMarker<'_>],
    pose: &Isometry3<f64>,
    options: &PoseOptions,
) -> f64 {
    markers
        .iter()
        .map(|marker| {
            let scale = options.robust_scale;
            if fits(marker, pose) {
                cost(marker.sights.iter(), pose, |_| scale)
            } else {
                marker.sights.iter().map(|sight| cauchy(sight.gate * sight.gate, scale)).sum()
            }
        })
        .sum()
}

/// How badly a rough pose agrees with the rays, from 0 to 1 for each ray: errors are measured by the
/// markers' sides, because a hypothesis from one marker is off by more than noise on the others.
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

fn roughly_fits(marker: &SightedMarker<'_>, pose: &Isometry3<f64>) -> bool {
    facing(marker, pose) > -0.2
        && marker.sights.iter().all(|sight| {
            error(sight, pose).is_some_and(|error| error.norm() < COARSE_GATE * sight.side)
        })
}

fn count(markers: &[SightedMarker<'_>], chosen: &[bool]) -> usize {
    chosen_sights(markers, chosen).count()
}

fn chosen_sights<'a>(
    markers: &'a [SightedMarker<'_>],
    chosen: &'a [bool],
) -> impl Iterator<Item = &'a Sight> + Clone {
    markers.iter().zip(chosen).filter(|&(_, &chosen)| chosen).flat_map(|(marker, _)| &marker.sights)
}

/// Levenberg-Marquardt (Marquardt's scaling by the diagonal) on the robust cost of the chosen
/// markers.
fn minimise(
    markers: &[SightedMarker<'_>],
    chosen: &[bool],
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
            // The floor keeps a direction that the rays say nothing of from being singular.
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

/// What a refined pose says of itself; `None` if no marker fits or the rays leave it open.
fn solution(
    markers: &[SightedMarker<'_>],
    inliers: &[bool],
    pose: Isometry3<f64>,
    options: &PoseOptions,
) -> Option<PoseSolution> {
    let sights = chosen_sights(markers, inliers);
    let inlier_corners = sights.clone().count();
    if inlier_corners < 4 {
        return None;
    }
    let matrix = normal(sights.clone(), &pose, |_| options.robust_scale)?.matrix;
    let covariance: Matrix6<f64> = matrix.cholesky()?.inverse();
    if !covariance.iter().chain(pose.translation.vector.iter()).all(|x| x.is_finite()) {
        return None;
    }
    let squares: f64 =
        sights.filter_map(|sight| error(sight, &pose)).map(|error| error.norm_squared()).sum();
    // Four rays or more: at least two degrees of freedom.
    let freedom = (2 * inlier_corners - 6) as f64;
    let fitting = || markers.iter().zip(inliers).filter(|&(_, &inlier)| inlier);
    Some(PoseSolution {
        camera_from_markers: pose,
        covariance,
        cost: consensus_cost(markers, &pose, options),
        reduced_chi_square: squares / freedom,
        inlier_markers: fitting().map(|(marker, _)| marker.marker.id).collect(),
        inlier_corners,
        corners: markers.iter().map(|marker| marker.sights.len()).sum(),
        faces_camera: fitting().all(|(marker, _)| facing(marker, &pose) > 0.0),
    })
}
