//! The two poses of one square marker from the rays of its four corners.
//!
//! Infinitesimal plane-based pose estimation (T. Collins, A. Bartoli, IJCV 109, 2014): a homography
//! from the marker to a plane across the rays, its Jacobian at the marker's centre, and from that
//! the two rotations that it leaves possible in closed form (their section 4), each with the
//! translation that fits the rays best.

use nalgebra::{
    Isometry3, Matrix2, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector2, Vector3,
};

use crate::Ray;

/// Both poses (`camera_from_marker`; the marker's frame as in
/// [`crate::body::Marker::markers_from_marker`]) of a square of this side, in metres, whose corners
/// are seen along `rays`, unit vectors in the camera frame, in ArUco's order.
///
/// Seen frontally, both are nearly the same. `None` for rays that are no picture of a square: more
/// than 80 degrees from their mean, on a line, or crossed.
pub(super) fn poses_of_square(side: f64, rays: &[Vector3<f64>; 4]) -> Option<[Isometry3<f64>; 2]> {
    // In a frame whose z axis is the rays' mean they are points of a picture, for any direction in
    // the camera frame.
    let mean = rays.iter().sum::<Vector3<f64>>().try_normalize(1e-6)?;
    let camera_from_picture = rotation_from_z(&mean);
    let mut corners = [Vector2::zeros(); 4];
    for (corner, ray) in corners.iter_mut().zip(rays) {
        let seen = camera_from_picture.inverse() * ray;
        if seen.z < 0.17 {
            return None;
        }
        *corner = Vector2::new(seen.x / seen.z, seen.y / seen.z);
    }
    let (centre, jacobian) = homography_at_centre(side, &corners)?;
    let rotations = rotations(&centre, &jacobian)?;
    let model = corners_of_square(side);
    let pose = |picture_from_marker: &Rotation3<f64>| {
        let rotation = camera_from_picture * picture_from_marker;
        let translation = translation(&rotation, &model, rays)?;
        let rotation = UnitQuaternion::from_rotation_matrix(&rotation);
        Some(Isometry3::from_parts(Translation3::from(translation), rotation))
    };
    Some([pose(&rotations[0])?, pose(&rotations[1])?])
}

/// Squared distance of the corners along `rays` from those of a square, in ArUco's order, in
/// standard deviations across each ray (radians). Two of a square's eight coordinates are not free,
/// so the tail of right corners' distances is that of a chi-square distribution of 2 degrees.
///
/// The nearer one of the two poses by [`poses_of_square`] counts. `None` for rays that are no
/// picture of a square.
pub fn squared_distance_from_square(rays: &[Ray; 4], deviations_rad: &[f64; 4]) -> Option<f64> {
    let poses = poses_of_square(1.0, &rays.map(Ray::into_inner))?;
    let squared_distance = |pose: &Isometry3<f64>| {
        let seen = rays.iter().zip(deviations_rad);
        let off =
            corners_of_square(1.0).into_iter().zip(seen).map(|(corner, (ray, deviation_rad))| {
                let towards = Ray::new_normalize(pose.rotation * corner + pose.translation.vector);
                (towards.angle(ray) / deviation_rad).powi(2)
            });
        off.sum::<f64>()
    };
    poses.iter().map(squared_distance).min_by(f64::total_cmp)
}

/// The corners of a square in its own frame (x right, y up), in ArUco's order.
fn corners_of_square(side: f64) -> [Vector3<f64>; 4] {
    let half = side / 2.0;
    [(-half, half), (half, half), (half, -half), (-half, -half)]
        .map(|(x, y)| Vector3::new(x, y, 0.0))
}

/// Point of the picture to which the homography from the marker (x right, y up, metres) maps the
/// marker's centre, and its Jacobian there.
fn homography_at_centre(
    side: f64,
    corners: &[Vector2<f64>; 4],
) -> Option<(Vector2<f64>, Matrix2<f64>)> {
    // From the unit square to a quadrilateral in closed form (P. Heckbert, "Fundamentals of Texture
    // Mapping and Image Warping", 1989, section 2.2.3): (u, v) runs from the bottom left corner.
    let [top_left, top_right, bottom_right, bottom_left] = corners;
    let sum = bottom_left - bottom_right + top_right - top_left;
    let first = bottom_right - top_right;
    let second = top_left - top_right;
    let determinant = first.perp(&second);
    let area = (top_right - bottom_left).perp(&(top_left - bottom_right));
    if !(determinant.abs() > 1e-12 && area.abs() > 1e-12) {
        return None;
    }
    let g = sum.perp(&second) / determinant;
    let h = first.perp(&sum) / determinant;
    let along_u = bottom_right - bottom_left + bottom_right * g;
    let along_v = top_left - bottom_left + top_left * h;
    let w = 1.0 + g / 2.0 + h / 2.0;
    // Points of the marker must not lie on both sides of the picture's horizon.
    if !(w > 1e-6 && 1.0 + g > 1e-6 && 1.0 + h > 1e-6 && 1.0 + g + h > 1e-6) {
        return None;
    }
    let centre = (along_u / 2.0 + along_v / 2.0 + bottom_left) / w;
    let column = |along: Vector2<f64>, k: f64| (along - centre * k) / (w * side);
    Some((centre, Matrix2::from_columns(&[column(along_u, g), column(along_v, h)])))
}

/// The two rotations `picture_from_marker` for which the marker's plane has this Jacobian at
/// `centre`, the picture of its centre.
fn rotations(centre: &Vector2<f64>, jacobian: &Matrix2<f64>) -> Option<[Rotation3<f64>; 2]> {
    let to_centre = rotation_from_z(&Vector3::new(centre.x, centre.y, 1.0).normalize());
    let turn = to_centre.matrix();
    let basis = turn.fixed_view::<2, 2>(0, 0) - centre * turn.fixed_view::<1, 2>(2, 0);
    let scaled = basis.try_inverse()? * jacobian;
    // The upper left of a rotation has 1 as its largest singular value; its scale is 1 / depth.
    let gram = scaled * scaled.transpose();
    let spread = ((gram[(0, 0)] - gram[(1, 1)]).powi(2) + 4.0 * gram[(0, 1)].powi(2)).sqrt();
    let scale = ((gram.trace() + spread) / 2.0).sqrt();
    if !(scale > 1e-9 && scale.is_finite()) {
        return None;
    }
    let flat = scaled / scale;
    // The third row follows from orthogonal unit columns up to its sign, which is the mirror.
    let column = |k: usize| (1.0 - flat.column(k).norm_squared()).max(0.0).sqrt();
    let b0 = column(0);
    let across = -flat.column(0).dot(&flat.column(1));
    let b1 = if across < 0.0 { -column(1) } else { column(1) };
    let rotation = |sign: f64| {
        let x = Vector3::new(flat[(0, 0)], flat[(1, 0)], sign * b0);
        let y = Vector3::new(flat[(0, 1)], flat[(1, 1)], sign * b1);
        let z = x.cross(&y);
        // Orthonormal up to rounding; normalised here.
        let x = x.normalize();
        let z = z.try_normalize(1e-9)?;
        Some(to_centre * Rotation3::from_basis_unchecked(&[x, z.cross(&x), z]))
    };
    Some([rotation(1.0)?, rotation(-1.0)?])
}

/// The translation with which the turned corners lie nearest to the rays, each error across its
/// ray.
fn translation(
    rotation: &Rotation3<f64>,
    model: &[Vector3<f64>; 4],
    rays: &[Vector3<f64>; 4],
) -> Option<Vector3<f64>> {
    let mut normal = Matrix3::zeros();
    let mut right = Vector3::zeros();
    for (corner, ray) in model.iter().zip(rays) {
        let across = Matrix3::identity() - ray * ray.transpose();
        normal += across;
        right -= across * (rotation * corner);
    }
    Some(normal.cholesky()?.solve(&right))
}

/// A rotation that takes the z axis to `direction`, a unit vector.
fn rotation_from_z(direction: &Vector3<f64>) -> Rotation3<f64> {
    // Straight back, any axis is valid.
    Rotation3::rotation_between(&Vector3::z(), direction)
        .unwrap_or_else(|| Rotation3::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI))
}
