//! Distance of a ray from its corner at a pose, with its derivative by the pose.

use nalgebra::{Isometry3, Matrix2x3, Matrix2x6, Matrix3, Matrix6, Vector2, Vector3, Vector6};

use super::rays::{Sight, SightedMarker};

/// Cosine of the largest angle at which a marker faces the camera: 93 degrees, since noise tilts
/// markers seen edge on.
const EDGE_ON: f64 = 0.052;

/// Error of a corner in standard deviations, in the plane tangent to the sphere at its ray.
///
/// It is 2 tan(angle / 2) times its direction, nearly the angle itself for all errors at a solution
/// (0.01 % more at 2 degrees). Unlike a sine or tangent, it rises all the way to straight behind.
/// `None` for a corner at the camera or straight behind.
pub(super) fn error(sight: &Sight, camera_from_markers: &Isometry3<f64>) -> Option<Vector2<f64>> {
    let seen = (camera_from_markers * sight.corner).coords;
    let direction = seen.try_normalize(1e-9)?;
    let along = 1.0 + sight.ray.dot(&direction);
    (along > 1e-9).then(|| sight.tangent.transpose() * direction * (2.0 * sight.weight / along))
}

/// The error with its derivative by the pose: position, then rotation vector, in the camera's axes
/// (`p = exp(rotation) R X + t + position`).
pub(super) fn error_and_jacobian(
    sight: &Sight,
    camera_from_markers: &Isometry3<f64>,
) -> Option<(Vector2<f64>, Matrix2x6<f64>)> {
    let arm = camera_from_markers.rotation * sight.corner.coords;
    let seen = arm + camera_from_markers.translation.vector;
    let range = seen.norm();
    let direction = seen.try_normalize(1e-9)?;
    let along = 1.0 + sight.ray.dot(&direction);
    if along <= 1e-9 {
        return None;
    }
    let scale = 2.0 * sight.weight / along;
    let across = sight.tangent.transpose();
    let error = across * direction * scale;
    let by_direction: Matrix2x3<f64> = across * scale - error * sight.ray.transpose() / along;
    let direction_by_point = (Matrix3::identity() - direction * direction.transpose()) / range;
    let by_point = by_direction * direction_by_point;
    Some((error, by_pose(&by_point, &arm)))
}

/// A derivative by the pose from that by a point, which lies at `arm` from the markers' origin.
pub(super) fn by_pose(by_point: &Matrix2x3<f64>, arm: &Vector3<f64>) -> Matrix2x6<f64> {
    let mut by_pose = Matrix2x6::zeros();
    by_pose.fixed_columns_mut::<3>(0).copy_from(by_point);
    by_pose.fixed_columns_mut::<3>(3).copy_from(&(-by_point * arm.cross_matrix()));
    by_pose
}

/// The pose moved by `step`: position, then rotation vector, in the camera's axes.
pub fn moved(pose: &Isometry3<f64>, step: &Vector6<f64>) -> Isometry3<f64> {
    let position: Vector3<f64> = step.fixed_rows::<3>(0).into_owned();
    let turn = step.fixed_rows::<3>(3).into_owned();
    let mut rotation = nalgebra::UnitQuaternion::from_scaled_axis(turn) * pose.rotation;
    rotation.renormalize();
    Isometry3::from_parts((pose.translation.vector + position).into(), rotation)
}

/// Cauchy's cost of a squared error: its logarithm beyond `scale` (both in standard deviations).
pub(super) fn cauchy(squared: f64, scale: f64) -> f64 {
    let scale = scale * scale;
    scale * (squared / scale).ln_1p()
}

/// Cosine of the angle between a marker's normal and the direction from it to the camera; positive
/// where its front is seen.
pub(super) fn facing(marker: &SightedMarker<'_>, camera_from_markers: &Isometry3<f64>) -> f64 {
    let centre = (camera_from_markers * marker.centre).coords;
    let normal = camera_from_markers.rotation * marker.normal;
    centre.try_normalize(1e-9).map_or(-1.0, |direction| -normal.dot(&direction))
}

/// The fitting rays of a marker: those within `gate`, if its front is visible or it is edge on, and
/// if they are more than half of its rays. A few corners of a misread marker may fit by chance.
pub(super) fn fitting(
    marker: &SightedMarker<'_>,
    camera_from_markers: &Isometry3<f64>,
    gate: impl Fn(&Sight) -> f64,
) -> Fitting {
    let mut fitting = [false; 4];
    if facing(marker, camera_from_markers) > -EDGE_ON {
        for (fits, sight) in fitting.iter_mut().zip(&marker.sights) {
            *fits = error(sight, camera_from_markers)
                .is_some_and(|error| error.norm_squared() < gate(sight).powi(2));
        }
    }
    if is_agreeing(marker, &fitting) { fitting } else { [false; 4] }
}

/// Whether each of a marker's rays fits, in their order.
pub(super) type Fitting = [bool; 4];

/// Whether more than half of a marker's rays fit.
pub(super) fn is_agreeing(marker: &SightedMarker<'_>, fitting: &Fitting) -> bool {
    2 * fitting.iter().filter(|&&fits| fits).count() > marker.sights.len()
}

/// The normal equations of the rays at a pose, robustly weighted.
pub(super) struct Normal {
    pub matrix: Matrix6<f64>,
    pub gradient: Vector6<f64>,
    /// Robust cost.
    pub cost: f64,
}

/// Robust cost of these rays; infinite where a corner is at the camera or straight behind.
pub(super) fn cost<'a>(
    sights: impl Iterator<Item = &'a Sight>,
    pose: &Isometry3<f64>,
    scale: impl Fn(&Sight) -> f64,
) -> f64 {
    sights
        .map(|sight| {
            error(sight, pose)
                .map_or(f64::INFINITY, |error| cauchy(error.norm_squared(), scale(sight)))
        })
        .sum()
}

/// The normal equations of these rays (iteratively reweighted for the same cost).
pub(super) fn normal<'a>(
    sights: impl Iterator<Item = &'a Sight>,
    pose: &Isometry3<f64>,
    scale: impl Fn(&Sight) -> f64,
) -> Option<Normal> {
    let mut normal = Normal { matrix: Matrix6::zeros(), gradient: Vector6::zeros(), cost: 0.0 };
    for sight in sights {
        let (error, jacobian) = error_and_jacobian(sight, pose)?;
        let scale = scale(sight);
        let squared = error.norm_squared();
        let weight = 1.0 / (1.0 + squared / (scale * scale));
        let weighted = jacobian.transpose() * weight;
        normal.matrix += weighted * jacobian;
        normal.gradient += weighted * error;
        normal.cost += cauchy(squared, scale);
    }
    normal.cost.is_finite().then_some(normal)
}
