//! A weighted ray, and functions that all adjustments use.

use nalgebra::{
    Isometry3, Matrix2x3, Matrix2x6, Matrix3, Matrix3x2, Matrix6, UnitQuaternion, Vector2, Vector3,
    Vector6,
};

use flockeye_geometry::pose::CornerRay;

/// Scale of the robust cost, in spreads of the errors.
pub(super) const ROBUST_SCALE: f64 = 3.0;
/// Share of the squares of normal errors that remains with Cauchy's weights at that scale. It is
/// the mean of x / (1 + x / 9) divided by 2, for x with mean 2.
pub(super) const WEIGHTED_SHARE: f64 = 0.7209;

/// One ray: direction, tangent plane, and weight (1/radians).
#[derive(Debug, Clone, Copy)]
pub(super) struct WeightedRay {
    ray: Vector3<f64>,
    tangent: Matrix3x2<f64>,
    weight: f64,
}

impl WeightedRay {
    pub(super) fn new(ray: &CornerRay) -> Self {
        let direction = ray.ray_in_camera.into_inner();
        let across = direction.cross(&Vector3::ith(direction.iamin(), 1.0)).normalize();
        Self {
            ray: direction,
            tangent: Matrix3x2::from_columns(&[across, direction.cross(&across)]),
            weight: 1.0 / ray.deviation_rad,
        }
    }

    /// Error from the ray to a point, in standard deviations across the ray. Its size is 2
    /// tan(angle / 2), which rises up to 180 degrees.
    pub(super) fn error(&self, point: &Vector3<f64>) -> Vector2<f64> {
        let direction = point.normalize();
        let along = (1.0 + self.ray.dot(&direction)).max(1e-9);
        self.tangent.transpose() * direction * (2.0 * self.weight / along)
    }

    /// The error with its derivative by the point.
    pub(super) fn linearized(&self, point: &Vector3<f64>) -> (Vector2<f64>, Matrix2x3<f64>) {
        let (range, direction) = (point.norm(), point.normalize());
        let along = (1.0 + self.ray.dot(&direction)).max(1e-9);
        let scale = 2.0 * self.weight / along;
        let across = self.tangent.transpose();
        let error = across * direction * scale;
        let by_direction: Matrix2x3<f64> = across * scale - error * self.ray.transpose() / along;
        let by_point = by_direction * (Matrix3::identity() - direction * direction.transpose());
        (error, by_point / range)
    }
}

/// The derivative by a shift, then by a turn, from the derivative by the point. `arm` is the point
/// relative to the centre of the turn.
pub(super) fn by_motion(by_point: &Matrix2x3<f64>, arm: &Vector3<f64>) -> Matrix2x6<f64> {
    let mut joined = Matrix2x6::zeros();
    joined.fixed_columns_mut::<3>(0).copy_from(by_point);
    joined.fixed_columns_mut::<3>(3).copy_from(&(-by_point * arm.cross_matrix()));
    joined
}

/// Cauchy's robust cost of a squared error.
pub(super) fn cauchy(squared: f64, scale: f64) -> f64 {
    let square = scale * scale;
    square * (squared / square).ln_1p()
}

/// Share of the squares of normal errors with two coordinates that remains with Cauchy's weights.
/// `mean` is the mean of their squared norm.
pub(super) fn weighted_share(mean: f64, scale: f64) -> f64 {
    // Squared norms are exponentially distributed. The midpoints of equally probable parts
    // represent them.
    const PARTS: u32 = 1000;
    let square = |part: u32| {
        let above = 1.0 - (f64::from(part) + 0.5) / f64::from(PARTS);
        -mean * above.ln()
    };
    let (weighted, all) = (0..PARTS).map(square).fold((0.0, 0.0), |(weighted, all), square| {
        (weighted + square / (1.0 + square / (scale * scale)), all + square)
    });
    weighted / all
}

/// The median error divided by the expected one, which is sqrt(2 ln 2) for two normal coordinates.
pub(super) fn spread(errors: impl Iterator<Item = Vector2<f64>>) -> f64 {
    let mut errors: Vec<f64> = errors.map(|error| error.norm()).collect();
    if errors.is_empty() {
        return 1.0;
    }
    let middle = errors.len() / 2;
    let (_, median, _) = errors.select_nth_unstable_by(middle, f64::total_cmp);
    *median / (2.0 * 2f64.ln()).sqrt()
}

/// Levenberg-Marquardt's damping, in proportion to the diagonal.
pub(super) fn damped(matrix: &Matrix6<f64>, damping: f64) -> Matrix6<f64> {
    matrix + Matrix6::from_diagonal(&(matrix.diagonal() * damping))
}

/// A pose moved by a shift and turned by a rotation vector about its own origin.
pub(super) fn moved(pose: &Isometry3<f64>, step: &Vector6<f64>) -> Isometry3<f64> {
    let shift: Vector3<f64> = step.fixed_rows::<3>(0).into_owned();
    let turn: Vector3<f64> = step.fixed_rows::<3>(3).into_owned();
    let mut rotation = UnitQuaternion::from_scaled_axis(turn) * pose.rotation;
    rotation.renormalize();
    Isometry3::from_parts((pose.translation.vector + shift).into(), rotation)
}

/// The step from one pose to another for [`moved`]: shift, then rotation vector, in the target's
/// axes.
pub(super) fn difference(from: &Isometry3<f64>, to: &Isometry3<f64>) -> Vector6<f64> {
    let shift = to.translation.vector - from.translation.vector;
    let turn = (to.rotation * from.rotation.inverse()).scaled_axis();
    Vector6::from_iterator(shift.iter().chain(turn.iter()).copied())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_leave_what_they_do_at_the_usual_scale() {
        let share = weighted_share(2.0, ROBUST_SCALE);
        assert!((share - WEIGHTED_SHARE).abs() < 2e-3, "{share}");
        assert!(weighted_share(1e-6, ROBUST_SCALE) > 0.999);
    }
}
