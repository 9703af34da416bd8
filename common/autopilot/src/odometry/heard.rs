//! Conversion of MAVLink's motion messages to the axes of REP-103.

use mavlink::dialects::development::{
    ATTITUDE_QUATERNION_DATA, LOCAL_POSITION_NED_DATA, MavFrame, ODOMETRY_DATA,
};
use nalgebra::{Isometry3, Matrix3, Matrix6, UnitQuaternion, Vector3};

use super::instant::{OdometryAt, OdometryFrame};
use crate::axes::{enu_from_ned, flip, flu_from_frd, from_wxyz};

/// Maximum position and velocity, metres and metres per second.
const LARGEST: f64 = 1e7;

/// `ODOMETRY`: position, attitude, velocities and covariance in one. None where its frames are not
/// those that autopilots send, or its numbers are invalid.
///
/// Frames: pose in `LOCAL_NED` or `LOCAL_FRD`, velocity in `BODY_FRD` or the pose's frame. Rates
/// are the body's in each case.
pub(super) fn from_odometry(message: &ODOMETRY_DATA) -> Option<OdometryAt> {
    let (frame, odom_from_local) = match message.frame_id {
        MavFrame::MAV_FRAME_LOCAL_NED => (OdometryFrame::Enu, enu_from_ned()),
        MavFrame::MAV_FRAME_LOCAL_FRD => (OdometryFrame::Flu, flu_from_frd()),
        _ => return None,
    };
    let local_from_frd = from_wxyz(message.q)?;
    let odom_from_base = odom_from_local * local_from_frd * flu_from_frd();
    let position = odom_from_local * vector([message.x, message.y, message.z])?;
    let velocity = vector([message.vx, message.vy, message.vz])?;
    let velocity_frd = match message.child_frame_id {
        MavFrame::MAV_FRAME_BODY_FRD => velocity,
        child if child == message.frame_id => local_from_frd.inverse() * velocity,
        _ => return None,
    };
    Some(OdometryAt {
        odom_from_base: Isometry3::from_parts(position.into(), odom_from_base),
        frame,
        covariance: covariance(&message.pose_covariance).map(|covariance| {
            // The position's block is along the local frame's axes, the rotation's along the body's
            // (FRD).
            let mut turn = Matrix6::zeros();
            turn.fixed_view_mut::<3, 3>(0, 0).copy_from(&matrix(&odom_from_local));
            turn.fixed_view_mut::<3, 3>(3, 3)
                .copy_from(&matrix(&(odom_from_local * local_from_frd)));
            turn * covariance * turn.transpose()
        }),
        linear_velocity_m_s: flip(&velocity_frd),
        angular_velocity_rad_s: rates([message.rollspeed, message.pitchspeed, message.yawspeed])?,
    })
}

/// A position and velocity in ENU, of `LOCAL_POSITION_NED`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct PositionSample {
    pub(super) position_enu_m: Vector3<f64>,
    pub(super) velocity_enu_m_s: Vector3<f64>,
}

pub(super) fn from_position(message: &LOCAL_POSITION_NED_DATA) -> Option<PositionSample> {
    Some(PositionSample {
        position_enu_m: enu_from_ned() * vector([message.x, message.y, message.z])?,
        velocity_enu_m_s: enu_from_ned() * vector([message.vx, message.vy, message.vz])?,
    })
}

/// An attitude and rates, of `ATTITUDE_QUATERNION`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct AttitudeSample {
    pub(super) enu_from_base: UnitQuaternion<f64>,
    pub(super) angular_velocity_rad_s: Vector3<f64>,
}

pub(super) fn from_attitude(message: &ATTITUDE_QUATERNION_DATA) -> Option<AttitudeSample> {
    let ned_from_frd = from_wxyz([message.q1, message.q2, message.q3, message.q4])?;
    Some(AttitudeSample {
        enu_from_base: enu_from_ned() * ned_from_frd * flu_from_frd(),
        angular_velocity_rad_s: rates([message.rollspeed, message.pitchspeed, message.yawspeed])?,
    })
}

fn vector(parts: [f32; 3]) -> Option<Vector3<f64>> {
    let vector = Vector3::from(parts.map(f64::from));
    // NaN fails this comparison too.
    (vector.amax() < LARGEST && vector.iter().all(|part| part.is_finite())).then_some(vector)
}

fn rates(frd: [f32; 3]) -> Option<Vector3<f64>> {
    vector(frd).map(|rates| flip(&rates))
}

fn matrix(rotation: &UnitQuaternion<f64>) -> Matrix3<f64> {
    rotation.to_rotation_matrix().into_inner()
}

/// The full matrix of the upper triangle, row by row. None where a variance is unknown. An unknown
/// covariance (PX4 sends variances only) counts as zero.
fn covariance(upper: &[f32; 21]) -> Option<Matrix6<f64>> {
    let mut full = Matrix6::zeros();
    let mut parts = upper.iter();
    for row in 0..6 {
        for column in row..6 {
            let part = f64::from(*parts.next()?);
            let is_known = part.is_finite() && (row != column || part >= 0.0);
            if row == column && !is_known {
                return None;
            }
            let part = if is_known { part } else { 0.0 };
            full[(row, column)] = part;
            full[(column, row)] = part;
        }
    }
    Some(full)
}

#[cfg(test)]
pub(crate) mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use std::f64::consts::FRAC_PI_2;

    use super::*;
    use crate::axes::to_wxyz;

    /// Three metres north, one east, two up, nose to the east, flying north at 4 m/s.
    pub(crate) fn message(time_usec: u64) -> ODOMETRY_DATA {
        let mut pose_covariance = [f32::NAN; 21];
        for (place, variance) in
            [0, 6, 11, 15, 18, 20].into_iter().zip([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
        {
            pose_covariance[place] = variance;
        }
        ODOMETRY_DATA {
            time_usec,
            frame_id: MavFrame::MAV_FRAME_LOCAL_NED,
            child_frame_id: MavFrame::MAV_FRAME_BODY_FRD,
            x: 3.0,
            y: 1.0,
            z: -2.0,
            q: to_wxyz(&UnitQuaternion::from_euler_angles(0.0, 0.0, FRAC_PI_2)),
            // North is to the left of the nose.
            vy: -4.0,
            yawspeed: 0.5,
            pose_covariance,
            ..ODOMETRY_DATA::DEFAULT
        }
    }

    fn close(found: Vector3<f64>, wanted: [f64; 3]) -> bool {
        (found - Vector3::from(wanted)).norm() < 1e-5
    }

    #[test]
    fn odometry_is_turned_to_enu_and_flu() {
        let found = from_odometry(&message(0)).unwrap();
        assert_eq!(found.frame, OdometryFrame::Enu);
        assert!(close(found.odom_from_base.translation.vector, [1.0, 3.0, 2.0]));
        // The nose to the east is ENU's zero.
        assert!(found.odom_from_base.rotation.angle() < 1e-5);
        assert!(close(found.linear_velocity_m_s, [0.0, 4.0, 0.0]), "to the left");
        assert!(close(found.angular_velocity_rad_s, [0.0, 0.0, -0.5]), "clockwise from above");
        let diagonal = found.covariance.unwrap().diagonal();
        // East, north, up; the body's x is east, its y (left) north.
        for (found, wanted) in diagonal.iter().zip([2.0, 1.0, 3.0, 0.1, 0.2, 0.3]) {
            assert!((found - wanted).abs() < 1e-6, "{diagonal}");
        }
    }

    #[test]
    fn velocities_along_the_local_frame_are_turned_to_the_body() {
        let local = ODOMETRY_DATA {
            child_frame_id: MavFrame::MAV_FRAME_LOCAL_NED,
            vx: 4.0,
            vy: 0.0,
            ..message(0)
        };
        assert!(close(from_odometry(&local).unwrap().linear_velocity_m_s, [0.0, 4.0, 0.0]));
    }

    #[test]
    fn without_north_the_frame_is_flu() {
        let frd = MavFrame::MAV_FRAME_LOCAL_FRD;
        let found = from_odometry(&ODOMETRY_DATA { frame_id: frd, ..message(0) }).unwrap();
        assert_eq!(found.frame, OdometryFrame::Flu);
        assert!(close(found.odom_from_base.translation.vector, [3.0, -1.0, 2.0]));
        let (_, _, yaw) = found.odom_from_base.rotation.euler_angles();
        assert!((yaw + FRAC_PI_2).abs() < 1e-5);
    }

    #[test]
    fn what_is_not_known_is_not_made_up() {
        let unknown = ODOMETRY_DATA { pose_covariance: [f32::NAN; 21], ..message(0) };
        assert_eq!(from_odometry(&unknown).unwrap().covariance, None);
        for wrong in [
            ODOMETRY_DATA { x: f32::NAN, ..message(0) },
            ODOMETRY_DATA { vz: f32::INFINITY, ..message(0) },
            ODOMETRY_DATA { q: [0.0; 4], ..message(0) },
            ODOMETRY_DATA { frame_id: MavFrame::MAV_FRAME_GLOBAL, ..message(0) },
            ODOMETRY_DATA { child_frame_id: MavFrame::MAV_FRAME_LOCAL_ENU, ..message(0) },
        ] {
            assert_eq!(from_odometry(&wrong), None);
        }
    }

    #[test]
    fn position_and_attitude_apart_say_the_same() {
        let whole = from_odometry(&message(0)).unwrap();
        let q = message(0).q;
        let attitude = ATTITUDE_QUATERNION_DATA {
            q1: q[0],
            q2: q[1],
            q3: q[2],
            q4: q[3],
            yawspeed: 0.5,
            ..ATTITUDE_QUATERNION_DATA::DEFAULT
        };
        let attitude = from_attitude(&attitude).unwrap();
        assert!(attitude.enu_from_base.angle_to(&whole.odom_from_base.rotation) < 1e-6);
        assert_eq!(attitude.angular_velocity_rad_s, whole.angular_velocity_rad_s);
        let position = LOCAL_POSITION_NED_DATA {
            x: 3.0,
            y: 1.0,
            z: -2.0,
            vx: 4.0,
            ..LOCAL_POSITION_NED_DATA::DEFAULT
        };
        let position = from_position(&position).unwrap();
        assert!(close(position.position_enu_m, [1.0, 3.0, 2.0]));
        assert!(close(position.velocity_enu_m_s, [0.0, 4.0, 0.0]));
    }
}
