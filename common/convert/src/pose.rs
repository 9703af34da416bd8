//! Poses, rotations and covariances: arrays of the contract and types of nalgebra.

use flockeye_contract::Pose;
use nalgebra::{Isometry3, Matrix6, Quaternion, Translation3, UnitQuaternion};

/// The rotation of a quaternion x, y, z, w, normalised.
pub fn rotation(xyzw: [f64; 4]) -> UnitQuaternion<f64> {
    UnitQuaternion::from_quaternion(Quaternion::from(xyzw))
}

/// The quaternion x, y, z, w of a rotation.
pub fn xyzw(rotation: &UnitQuaternion<f64>) -> [f64; 4] {
    rotation.coords.into()
}

/// A transform as a pose of the contract.
pub fn pose(isometry: &Isometry3<f64>) -> Pose {
    Pose { position: isometry.translation.vector.into(), orientation: xyzw(&isometry.rotation) }
}

/// The transform of a contract's pose; its quaternion is normalised.
pub fn isometry(pose: &Pose) -> Isometry3<f64> {
    Isometry3::from_parts(Translation3::from(pose.position), rotation(pose.orientation))
}

/// A 6x6 matrix row by row, the order of the contract's covariances.
pub fn row_major(matrix: &Matrix6<f64>) -> [f64; 36] {
    // nalgebra stores columns. A covariance is symmetric, but rounding may break that.
    std::array::from_fn(|k| matrix[(k / 6, k % 6)])
}

/// The 6x6 matrix of a contract's covariance, which lies row by row.
pub fn matrix6(row_major: &[f64; 36]) -> Matrix6<f64> {
    Matrix6::from_row_slice(row_major)
}

/// Upper triangle of a 6x6 row-major matrix, row by row, the order of covariances in reports.
pub fn upper_triangle(matrix: &[f64; 36]) -> [f64; 21] {
    let mut cells = (0..6).flat_map(|row| (row..6).map(move |column| matrix[6 * row + column]));
    // 6 + 5 + 4 + 3 + 2 + 1 cells: the iterator has exactly as many as the array.
    std::array::from_fn(|_| cells.next().unwrap_or(0.0))
}

/// The whole of a symmetric 6x6 matrix, from its upper triangle, row by row.
pub fn symmetric6(upper: &[f64; 21]) -> Matrix6<f64> {
    Matrix6::from_fn(|row, column| {
        let (row, column) = (row.min(column), row.max(column));
        upper[6 * row - row * row.saturating_sub(1) / 2 + column - row]
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pose_comes_back_as_it_was() {
        let turn = UnitQuaternion::from_euler_angles(0.1, -0.4, 2.0);
        let transform = Isometry3::from_parts(Translation3::new(1.0, -2.0, 3.0), turn);
        let message = pose(&transform);
        assert_eq!(message.position, [1.0, -2.0, 3.0]);
        assert_eq!(message.orientation, [turn.i, turn.j, turn.k, turn.w]);
        let back = isometry(&message);
        assert!((back.translation.vector - transform.translation.vector).norm() == 0.0);
        assert!(back.rotation.angle_to(&turn) < 1e-12);
    }

    #[test]
    fn a_quarter_turn_about_z_is_x_y_z_w() {
        let half = std::f64::consts::FRAC_1_SQRT_2;
        let turned = rotation([0.0, 0.0, half, half]) * nalgebra::Vector3::x();
        assert!((turned - nalgebra::Vector3::y()).norm() < 1e-12);
        // Twice as long: the same rotation.
        let turned = rotation([0.0, 0.0, 2.0, 2.0]) * nalgebra::Vector3::x();
        assert!((turned - nalgebra::Vector3::y()).norm() < 1e-12);
    }

    #[test]
    fn covariances_lie_row_by_row() {
        let numbers: [f64; 36] = std::array::from_fn(|k| k as f64);
        let matrix = matrix6(&numbers);
        assert_eq!((matrix[(0, 1)], matrix[(1, 0)]), (1.0, 6.0));
        assert_eq!(row_major(&matrix), numbers);
    }

    #[test]
    fn a_covariance_is_its_upper_triangle() {
        let number = |row: usize, column: usize| (10 * row.min(column) + row.max(column)) as f64;
        let whole = Matrix6::from_fn(number);
        let upper = upper_triangle(&row_major(&whole));
        assert_eq!(upper[..8], [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 11.0, 12.0]);
        assert_eq!(symmetric6(&upper), whole);
    }
}
