//! Conversions between the axes of MAVLink and those of REP-103.
//!
//! MAVLink: body x forward, y right, z down (FRD), world x north, y east, z down (NED). REP-103:
//! body x forward, y left, z up (FLU), world x east, y north, z up (ENU). Both changes are half
//! turns, so each is its own inverse.

use std::f64::consts::PI;

use nalgebra::{Quaternion, Unit, UnitQuaternion, Vector3};

/// The half turn about x that leads from FRD to FLU and back.
pub(crate) fn flu_from_frd() -> UnitQuaternion<f64> {
    UnitQuaternion::from_axis_angle(&Vector3::x_axis(), PI)
}

/// The half turn about the axis between north and east that leads from NED to ENU and back.
pub(crate) fn enu_from_ned() -> UnitQuaternion<f64> {
    UnitQuaternion::from_axis_angle(&Unit::new_normalize(Vector3::new(1.0, 1.0, 0.0)), PI)
}

/// Converts a vector between the two body axes. It is exact: only signs change.
pub(crate) fn flip(vector: &Vector3<f64>) -> Vector3<f64> {
    Vector3::new(vector.x, -vector.y, -vector.z)
}

/// A rotation in MAVLink's order w, x, y, z, with w not negative.
pub(crate) fn to_wxyz(rotation: &UnitQuaternion<f64>) -> [f32; 4] {
    let q = rotation.quaternion();
    let sign = if q.w < 0.0 { -1.0 } else { 1.0 };
    [q.w, q.i, q.j, q.k].map(|part| (sign * part) as f32)
}

/// A rotation from MAVLink's order w, x, y, z; none where the numbers are not a unit quaternion.
pub(crate) fn from_wxyz([w, x, y, z]: [f32; 4]) -> Option<UnitQuaternion<f64>> {
    let [w, x, y, z] = [w, x, y, z].map(f64::from);
    let quaternion = Quaternion::new(w, x, y, z);
    // Autopilots send single precision; a larger error of the norm cannot be rounding.
    let is_unit = (quaternion.norm() - 1.0).abs() < 1e-2;
    is_unit.then(|| UnitQuaternion::new_normalize(quaternion))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_axes_are_where_they_belong() {
        let [x, y, z] = [Vector3::x(), Vector3::y(), Vector3::z()];
        let close = |found: Vector3<f64>, wanted: Vector3<f64>| (found - wanted).norm() < 1e-12;
        let body = flu_from_frd();
        assert!(close(body * x, x) && close(body * y, -y) && close(body * z, -z));
        // North is ENU's y, east its x.
        let world = enu_from_ned();
        assert!(close(world * x, y) && close(world * y, x) && close(world * z, -z));
        let vector = Vector3::new(1.0, 2.0, 3.0);
        assert!(close(flip(&vector), body * vector));
    }

    #[test]
    fn quaternions_go_there_and_back() {
        let rotation = UnitQuaternion::from_euler_angles(0.1, -0.7, 3.0);
        assert!(from_wxyz(to_wxyz(&rotation)).is_some_and(|q| q.angle_to(&rotation) < 1e-6));
        for wrong in [[0.0; 4], [f32::NAN, 0.0, 0.0, 0.0], [2.0, 0.0, 0.0, 0.0]] {
            assert_eq!(from_wxyz(wrong), None);
        }
    }
}
