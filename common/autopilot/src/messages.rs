//! Conversion of states and times to MAVLink messages, as pure functions.
//!
//! `TARGET_RELATIVE` (511) is of MAVLink's development messages, `OBSTACLE_DISTANCE_3D` (11037) of
//! ArduPilot's; the definitions are in `development.xml` and `ardupilotmega.xml` of
//! <https://github.com/mavlink/mavlink>.

use mavlink::dialects::ardupilotmega::{MavDistanceSensor, MavFrame, OBSTACLE_DISTANCE_3D_DATA};
use mavlink::dialects::development::{
    COMMAND_LONG_DATA, HEARTBEAT_DATA, LandingTargetType, MavAutopilot, MavCmd, MavModeFlag,
    MavState, MavType, TARGET_RELATIVE_DATA, TIMESYNC_DATA, TargetObsFrame,
};
use mavlink::{MAVLinkV2MessageRaw, MavHeader, MessageData};
use nalgebra::UnitQuaternion;

use crate::axes::{enu_from_ned, flip, flu_from_frd, to_wxyz};
use crate::neighbour::NeighbourState;

/// The autopilot's component.
pub const AUTOPILOT: u8 = 1;

/// A message to the autopilot.
#[derive(Debug, Clone, PartialEq)]
pub enum Outgoing {
    /// Presence of an onboard computer.
    Heartbeat(HEARTBEAT_DATA),
    /// A time request, or an answer to one.
    Timesync(TIMESYNC_DATA),
    /// The target.
    Target(TARGET_RELATIVE_DATA),
    /// A neighbour as an obstacle.
    Obstacle(OBSTACLE_DISTANCE_3D_DATA),
    /// A request to send a message.
    Command(COMMAND_LONG_DATA),
}

impl Outgoing {
    /// The encoded message.
    pub fn frame(&self, header: MavHeader) -> MAVLinkV2MessageRaw {
        fn whole<D: MessageData>(header: MavHeader, message: &D) -> MAVLinkV2MessageRaw {
            let mut raw = MAVLinkV2MessageRaw::new();
            raw.serialize_message_data(header, message);
            raw
        }
        match self {
            Self::Heartbeat(message) => whole(header, message),
            Self::Timesync(message) => whole(header, message),
            Self::Target(message) => whole(header, message),
            Self::Obstacle(message) => whole(header, message),
            Self::Command(message) => whole(header, message),
        }
    }
}

/// The target's position and attitude along the body's axes (FRD), with standard deviations. The
/// drone's attitude at the exposure lets the receiver rotate it to NED without a guess.
pub fn target(
    id: u8,
    state: &NeighbourState,
    exposure_utc_ns: i64,
    enu_from_base: Option<&UnitQuaternion<f64>>,
) -> TARGET_RELATIVE_DATA {
    let pose = state.observer_from_target;
    let position = flip(&pose.translation.vector);
    let deviation = |place: usize| state.covariance[(place, place)].max(0.0).sqrt() as f32;
    // With zeros the receiver uses its own attitude.
    let q_sensor = enu_from_base.map_or([0.0; 4], |enu_from_base| {
        to_wxyz(&(enu_from_ned() * enu_from_base * flu_from_frd()))
    });
    TARGET_RELATIVE_DATA {
        timestamp: u64::try_from(exposure_utc_ns / 1000).unwrap_or(0),
        x: position.x as f32,
        y: position.y as f32,
        z: position.z as f32,
        // Flipping an axis does not change its standard deviation.
        pos_std: [deviation(0), deviation(1), deviation(2)],
        yaw_std: deviation(5),
        q_target: to_wxyz(&(flu_from_frd() * pose.rotation * flu_from_frd())),
        q_sensor,
        id,
        frame: TargetObsFrame::TARGET_OBS_FRAME_BODY_FRD,
        mavtype: LandingTargetType::LANDING_TARGET_TYPE_VISION_FIDUCIAL,
    }
}

/// A neighbour as an obstacle at a point of the body's axes (FRD). `time_boot_ms` is equal for all
/// obstacles of one frame, and differs for the next: ArduPilot drops the obstacles of another time.
pub fn obstacle(
    id: u8,
    state: &NeighbourState,
    time_boot_ms: u32,
    range_m: [f64; 2],
) -> OBSTACLE_DISTANCE_3D_DATA {
    let position = flip(&state.observer_from_target.translation.vector);
    OBSTACLE_DISTANCE_3D_DATA {
        time_boot_ms,
        x: position.x as f32,
        y: position.y as f32,
        z: position.z as f32,
        min_distance: range_m[0] as f32,
        max_distance: range_m[1] as f32,
        obstacle_id: u16::from(id),
        sensor_type: MavDistanceSensor::MAV_DISTANCE_SENSOR_UNKNOWN,
        frame: MavFrame::MAV_FRAME_BODY_FRD,
    }
}

/// The heartbeat of an onboard computer.
pub fn heartbeat() -> HEARTBEAT_DATA {
    HEARTBEAT_DATA {
        custom_mode: 0,
        mavtype: MavType::MAV_TYPE_ONBOARD_CONTROLLER,
        autopilot: MavAutopilot::MAV_AUTOPILOT_INVALID,
        base_mode: MavModeFlag::empty(),
        system_status: MavState::MAV_STATE_ACTIVE,
        mavlink_version: 3,
    }
}

/// A request for the autopilot's time.
pub fn time_request(system: u8, stamp: i64) -> TIMESYNC_DATA {
    TIMESYNC_DATA { tc1: 0, ts1: stamp, target_system: system, target_component: AUTOPILOT }
}

/// The answer to a time request, from this system and component.
pub fn time_answer(
    request: &TIMESYNC_DATA,
    system: u8,
    component: u8,
    time_ns: i64,
) -> TIMESYNC_DATA {
    TIMESYNC_DATA {
        tc1: time_ns,
        ts1: request.ts1,
        target_system: system,
        target_component: component,
    }
}

/// A request to the autopilot to send a message at a rate of `hz`.
pub fn ask_for(system: u8, message: u32, hz: f64) -> COMMAND_LONG_DATA {
    COMMAND_LONG_DATA {
        target_system: system,
        target_component: AUTOPILOT,
        command: MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL,
        param1: message as f32,
        param2: (1e6 / hz) as f32,
        ..COMMAND_LONG_DATA::DEFAULT
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use std::f64::consts::FRAC_PI_2;

    use super::*;
    use crate::neighbour::tests::neighbour;

    const UTC: i64 = 1_700_000_000_000_000_000;

    #[test]
    fn a_target_ahead_and_left_is_ahead_and_negative_right() {
        let found = target(3, &neighbour("kite", 2_000_000), UTC + 2_000_000, None);
        assert_eq!((found.x, found.y, found.z), (2.0, -1.0, -0.5));
        assert_eq!(found.pos_std, [0.2, 0.3, 0.4]);
        assert_eq!((found.yaw_std, found.id), (0.5, 3));
        assert_eq!(found.timestamp, (UTC / 1000 + 2000) as u64);
        assert_eq!(found.q_sensor, [0.0; 4]);
        // It is turned to the left by half a radian, which about down is negative.
        let wanted = to_wxyz(&UnitQuaternion::from_euler_angles(0.0, 0.0, -0.5));
        for (found, wanted) in found.q_target.iter().zip(wanted) {
            assert!((found - wanted).abs() < 1e-6);
        }
    }

    #[test]
    fn the_attitude_at_the_exposure_goes_along() {
        // The nose to the east: zero in ENU, a quarter clockwise in NED.
        let east = UnitQuaternion::identity();
        let found = target(0, &neighbour("kite", 0), UTC, Some(&east));
        let wanted = to_wxyz(&UnitQuaternion::from_euler_angles(0.0, 0.0, FRAC_PI_2));
        for (found, wanted) in found.q_sensor.iter().zip(wanted) {
            assert!((found - wanted).abs() < 1e-6, "{found} {wanted}");
        }
    }

    #[test]
    fn obstacles_are_points_of_the_body() {
        let found = obstacle(63, &neighbour("kite", 0), 77, [0.5, 40.0]);
        assert_eq!((found.x, found.y, found.z), (2.0, -1.0, -0.5));
        assert_eq!((found.min_distance, found.max_distance), (0.5, 40.0));
        assert_eq!((found.obstacle_id, found.time_boot_ms), (63, 77));
        assert_eq!(found.frame, MavFrame::MAV_FRAME_BODY_FRD);
    }

    /// The checksum's seed follows from the definition
    /// (https://mavlink.io/en/guide/serialization.html#crc_extra): a definition that changes is
    /// refused by the autopilot. Names of the fields as they are sent, by size.
    #[test]
    fn the_definitions_are_those_that_autopilots_have() {
        fn seed(name: &str, fields: &[(&str, &str, u8)]) -> u8 {
            let mut text: Vec<u8> = format!("{name} ").into_bytes();
            for (kind, field, length) in fields {
                text.extend(format!("{kind} {field} ").bytes());
                text.extend((*length > 0).then_some(length));
            }
            let crc = mavlink::calculate_crc(&text[..text.len() - 1], text[text.len() - 1]);
            (crc & 0xff) as u8 ^ (crc >> 8) as u8
        }
        // A message that everybody knows shows that the computation is right.
        let heartbeat = [
            ("uint32_t", "custom_mode", 0),
            ("uint8_t", "type", 0),
            ("uint8_t", "autopilot", 0),
            ("uint8_t", "base_mode", 0),
            ("uint8_t", "system_status", 0),
            ("uint8_t", "mavlink_version", 0),
        ];
        assert_eq!((seed("HEARTBEAT", &heartbeat), HEARTBEAT_DATA::EXTRA_CRC), (50, 50));
        let target = [
            ("uint64_t", "timestamp", 0),
            ("float", "x", 0),
            ("float", "y", 0),
            ("float", "z", 0),
            ("float", "pos_std", 3),
            ("float", "yaw_std", 0),
            ("float", "q_target", 4),
            ("float", "q_sensor", 4),
            ("uint8_t", "id", 0),
            ("uint8_t", "frame", 0),
            ("uint8_t", "type", 0),
        ];
        assert_eq!((seed("TARGET_RELATIVE", &target), TARGET_RELATIVE_DATA::EXTRA_CRC), (28, 28));
        assert_eq!(TARGET_RELATIVE_DATA::ID, 511);
        let obstacle = [
            ("uint32_t", "time_boot_ms", 0),
            ("float", "x", 0),
            ("float", "y", 0),
            ("float", "z", 0),
            ("float", "min_distance", 0),
            ("float", "max_distance", 0),
            ("uint16_t", "obstacle_id", 0),
            ("uint8_t", "sensor_type", 0),
            ("uint8_t", "frame", 0),
        ];
        let found = seed("OBSTACLE_DISTANCE_3D", &obstacle);
        assert_eq!((found, OBSTACLE_DISTANCE_3D_DATA::EXTRA_CRC), (130, 130));
        assert_eq!(OBSTACLE_DISTANCE_3D_DATA::ID, 11037);
    }
}
