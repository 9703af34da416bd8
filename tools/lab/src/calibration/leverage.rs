//! The position error at a distance due to an uncertain transform.

use std::f64::consts::PI;

use nalgebra::{Matrix3, Matrix6, Vector3};

/// Number of directions that are tried.
const DIRECTIONS: u32 = 2000;
/// Angle from one direction to the next about the axis: pi (3 - sqrt 5), radians.
const GOLDEN_ANGLE: f64 = 2.399_963_229_728_653;

/// The position error of an object at `distance_m` from a transform's source, in the worst
/// direction. It is the root of the expected squared distance, metres.
///
/// `covariance` is that of the transform: position (m), then rotation vector (rad) about the
/// source's origin, both in the target's axes. For one known error `e` it is `e * e.transpose()`.
/// Only directions with `is_seen` count, unit vectors in the target's axes.
pub(super) fn worst_error_m(
    covariance: &Matrix6<f64>,
    distance_m: f64,
    is_seen: impl Fn(&Vector3<f64>) -> bool,
) -> f64 {
    let block = |row: usize, column: usize| -> Matrix3<f64> {
        covariance.fixed_view::<3, 3>(row, column).into_owned()
    };
    let (shift, joint, turn) = (block(0, 0), block(0, 3), block(3, 3));
    // The expected cross product of shift and turn.
    let cross = Vector3::new(
        joint[(1, 2)] - joint[(2, 1)],
        joint[(2, 0)] - joint[(0, 2)],
        joint[(0, 1)] - joint[(1, 0)],
    );
    // The error is shift + turn x (distance * direction).
    let squared = |direction: Vector3<f64>| {
        let by_turn = turn.trace() - direction.dot(&(turn * direction));
        shift.trace() + 2.0 * distance_m * cross.dot(&direction) + distance_m * distance_m * by_turn
    };
    let directions = (0..DIRECTIONS).map(|k| {
        let z = 1.0 - (2.0 * f64::from(k) + 1.0) / f64::from(DIRECTIONS);
        let (across, longitude) = ((1.0 - z * z).sqrt(), f64::from(k) * GOLDEN_ANGLE % (2.0 * PI));
        Vector3::new(across * longitude.cos(), across * longitude.sin(), z)
    });
    directions.filter(is_seen).map(squared).fold(0.0, f64::max).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector6;

    #[test]
    fn a_turn_counts_with_the_distance_and_a_shift_does_not() {
        let everywhere = |_: &Vector3<f64>| true;
        let of = |error: Vector6<f64>, distance_m: f64| {
            worst_error_m(&(error * error.transpose()), distance_m, everywhere)
        };
        let shift = Vector6::new(0.003, 0.0, 0.004, 0.0, 0.0, 0.0);
        assert!((of(shift, 1.5) - 0.005).abs() < 1e-9);
        let turn = Vector6::new(0.0, 0.0, 0.0, 0.0, 0.0, 0.01);
        assert!((of(turn, 1.5) - 0.015).abs() < 1e-5);
        // 0.01 rad about z move what is straight ahead by 15 mm to the left, what is behind to the
        // right.
        let both = Vector6::new(0.0, 0.003, 0.0, 0.0, 0.0, 0.01);
        assert!((of(both, 1.5) - 0.018).abs() < 1e-5);
        let behind = worst_error_m(&(both * both.transpose()), 1.5, |to| to.x < -0.999);
        assert!((behind - 0.012).abs() < 1e-4, "{behind}");
    }

    #[test]
    fn deviations_add_as_squares() {
        let covariance = Matrix6::from_diagonal(&Vector6::new(1.0, 1.0, 1.0, 4.0, 4.0, 4.0));
        // Three of shift, and two of the turn across: 3 + 2 * 4 * 0.25.
        let found = worst_error_m(&covariance, 0.5, |_| true);
        assert!((found - 5f64.sqrt()).abs() < 1e-9, "{found}");
    }
}
