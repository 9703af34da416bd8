//! The camera's own rotation: messages of the contract and types of geometry.

use flockeye_contract::{FrameStamp, Rotation, RotationSource};
use flockeye_geometry::ego_rotation::{CameraTurn, TurnAhead};
use nalgebra::Matrix3;

use crate::pose::{rotation, xyzw};

/// Rotation in a message; `None` where the message states that it is unknown.
pub fn camera_turn(message: &Rotation) -> Option<CameraTurn> {
    if message.source == RotationSource::Nothing.code() {
        return None;
    }
    Some(CameraTurn {
        earlier_s: message.earlier_exposure_ns as f64 * 1e-9,
        later_s: message.stamp.exposure_s(),
        later_from_earlier: rotation(message.later_from_earlier),
        covariance: Matrix3::from_row_slice(&message.covariance),
        rate_in_camera: message.rate_in_camera.into(),
        rate_covariance: Matrix3::from_row_slice(&message.rate_covariance),
        ahead: message.is_known_ahead().then(|| TurnAhead {
            until_s: message.ahead_ns as f64 * 1e-9,
            ahead_from_later: rotation(message.ahead_from_later),
            covariance: Matrix3::from_row_slice(&message.ahead_covariance),
            rate_in_camera: message.ahead_rate_in_camera.into(),
            rate_covariance: Matrix3::from_row_slice(&message.ahead_rate_covariance),
        }),
    })
}

/// The message for a turn between the exposures of two frames.
pub fn rotation_message(
    earlier: &FrameStamp,
    stamp: &FrameStamp,
    turn: &CameraTurn,
    source: RotationSource,
    generation: u32,
) -> Rotation {
    let known = Rotation {
        stamp: *stamp,
        earlier_exposure_ns: earlier.exposure_ns,
        later_from_earlier: xyzw(&turn.later_from_earlier),
        covariance: row_major(&turn.covariance),
        rate_in_camera: turn.rate_in_camera.into(),
        rate_covariance: row_major(&turn.rate_covariance),
        source: source.code(),
        generation,
        ahead_ns: stamp.exposure_ns,
        ..Rotation::default()
    };
    let Some(ahead) = &turn.ahead else { return known };
    Rotation {
        ahead_ns: (ahead.until_s * 1e9).round() as i64,
        ahead_from_later: xyzw(&ahead.ahead_from_later),
        ahead_covariance: row_major(&ahead.covariance),
        ahead_rate_in_camera: ahead.rate_in_camera.into(),
        ahead_rate_covariance: row_major(&ahead.rate_covariance),
        ..known
    }
}

/// A covariance row by row, made symmetric: rounding may break the symmetry.
fn row_major(matrix: &Matrix3<f64>) -> [f64; 9] {
    let symmetric = (matrix + matrix.transpose()) / 2.0;
    std::array::from_fn(|k| symmetric[(k / 3, k % 3)])
}

#[cfg(test)]
mod tests {
    #![allow(clippy::expect_used)]
    use super::*;
    use flockeye_contract::{Rotations, Topic};
    use nalgebra::{UnitQuaternion, Vector3};

    #[test]
    fn a_turn_comes_back_as_it_was() {
        let at = |exposure_ns| FrameStamp { exposure_ns, ..FrameStamp::default() };
        let turn = CameraTurn {
            earlier_s: 2.0,
            later_s: 2.5,
            later_from_earlier: UnitQuaternion::from_euler_angles(0.1, -0.2, 0.3),
            covariance: Matrix3::new(3.0, 0.5, 0.1, 0.5, 4.0, 0.2, 0.1, 0.2, 5.0),
            rate_in_camera: Vector3::new(0.1, -0.2, 0.3),
            rate_covariance: Matrix3::from_diagonal_element(0.01),
            ahead: Some(TurnAhead {
                until_s: 2.75,
                ahead_from_later: UnitQuaternion::identity(),
                covariance: Matrix3::from_diagonal_element(1e-6),
                rate_in_camera: Vector3::new(0.2, -0.1, 0.3),
                rate_covariance: Matrix3::from_diagonal_element(0.02),
            }),
        };
        let (earlier, later) = (at(2_000_000_000), at(2_500_000_000));
        let message = rotation_message(&earlier, &later, &turn, RotationSource::Picture, 3);
        assert_eq!(Rotations::check(&message, &[]), Ok(()));
        let read = camera_turn(&message).expect("it is known");
        // The quaternion is normalised once more.
        assert!(read.later_from_earlier.angle_to(&turn.later_from_earlier) < 1e-12);
        let later_from_earlier = turn.later_from_earlier;
        assert_eq!(CameraTurn { later_from_earlier, ..read }, turn);
        let unknown = Rotation { source: RotationSource::Nothing.code(), ..message };
        assert_eq!(camera_turn(&unknown), None);
    }
}
