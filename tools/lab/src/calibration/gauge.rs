//! The gauge of an adjustment: it fixes the pose of the whole body, which rays do not determine.

use nalgebra::{DMatrix, Isometry3, Matrix3, Point3, Rotation3, UnitQuaternion, Vector3};

/// The least-squares motion that moves the points `from` onto the points `onto` (Kabsch, "A
/// solution for the best rotation to relate two sets of vectors", 1976).
pub fn alignment(from: &[Point3<f64>], onto: &[Point3<f64>]) -> Isometry3<f64> {
    let middle = |points: &[Point3<f64>]| {
        points.iter().map(|p| p.coords).sum::<Vector3<f64>>() / points.len().max(1) as f64
    };
    let (from_middle, onto_middle) = (middle(from), middle(onto));
    let products = from
        .iter()
        .zip(onto)
        .map(|(a, b)| (b.coords - onto_middle) * (a.coords - from_middle).transpose());
    let rotation = Rotation3::from_matrix_eps(
        &products.sum::<Matrix3<f64>>(),
        1e-12,
        200,
        Rotation3::identity(),
    );
    let rotation = UnitQuaternion::from_rotation_matrix(&rotation);
    Isometry3::from_parts((onto_middle - rotation * from_middle).into(), rotation)
}

/// The six conditions of that alignment for small changes: a row each. Its columns are three of
/// shift and three of turn about the own centre for each marker, whose corners are given.
pub(super) fn conditions(markers: &[[Point3<f64>; 4]]) -> DMatrix<f64> {
    let size = (markers.iter().flatten().map(|p| p.coords.norm_squared()).sum::<f64>()
        / (4 * markers.len().max(1)) as f64)
        .sqrt()
        .max(1e-6);
    let mut conditions = DMatrix::zeros(6, 6 * markers.len());
    for (k, corners) in markers.iter().enumerate() {
        let centre = corners.iter().map(|p| p.coords).sum::<Vector3<f64>>() / 4.0;
        for corner in corners {
            // A corner moves by shift + turn x arm. The sum and the moment of all corners' moves
            // are 0.
            let by_turn = -(corner.coords - centre).cross_matrix();
            let moment = corner.coords.cross_matrix() / size;
            let mut add = |row: usize, column: usize, block: &Matrix3<f64>| {
                let mut view = conditions.fixed_view_mut::<3, 3>(row, 6 * k + column);
                view += block;
            };
            add(0, 0, &Matrix3::identity());
            add(0, 3, &by_turn);
            add(3, 0, &moment);
            add(3, 3, &(moment * by_turn));
        }
    }
    conditions
}
