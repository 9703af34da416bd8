//! MAVLink messages that contain samples of an inertial sensor.

use mavlink::dialects::development::{HighresImuUpdatedFlags, MavMessage};

/// Message that contained a sample. Later ones in this list are better.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum MessageKind {
    /// `ATTITUDE_QUATERNION`: rates filtered by the autopilot, without bias; time to a millisecond.
    AttitudeQuaternion,
    /// `HIGHRES_IMU`: rate and specific force; time to a microsecond.
    HighresImu,
}

/// A sample as the autopilot sends it, along Flockeye's axes: x forward, y left, z up.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AutopilotSample {
    /// The message that contained it.
    pub kind: MessageKind,
    /// The autopilot's time, microseconds.
    pub time_us: u64,
    /// Angular velocity, rad/s.
    pub rate: [f64; 3],
    /// Specific force, m/s^2; NaN where the message has none.
    pub specific_force: [f64; 3],
}

/// The sample in a message; `None` for all other messages, and without new data of the gyroscope.
pub(crate) fn sample(message: &MavMessage) -> Option<AutopilotSample> {
    match message {
        MavMessage::HIGHRES_IMU(imu) => {
            let gyroscope = HighresImuUpdatedFlags::HIGHRES_IMU_UPDATED_XGYRO
                | HighresImuUpdatedFlags::HIGHRES_IMU_UPDATED_YGYRO
                | HighresImuUpdatedFlags::HIGHRES_IMU_UPDATED_ZGYRO;
            imu.fields_updated.contains(gyroscope).then(|| AutopilotSample {
                kind: MessageKind::HighresImu,
                time_us: imu.time_usec,
                rate: forward_left_up([imu.xgyro, imu.ygyro, imu.zgyro]),
                specific_force: forward_left_up([imu.xacc, imu.yacc, imu.zacc]),
            })
        }
        MavMessage::ATTITUDE_QUATERNION(attitude) => Some(AutopilotSample {
            kind: MessageKind::AttitudeQuaternion,
            time_us: u64::from(attitude.time_boot_ms) * 1000,
            rate: forward_left_up([attitude.rollspeed, attitude.pitchspeed, attitude.yawspeed]),
            specific_force: [f64::NAN; 3],
        }),
        _ => None,
    }
}

/// MAVLink's body axes are x forward, y right, z down.
fn forward_left_up([forward, right, down]: [f32; 3]) -> [f64; 3] {
    [f64::from(forward), -f64::from(right), -f64::from(down)]
}

#[cfg(test)]
mod tests {
    use super::*;
    use mavlink::dialects::development::{
        ATTITUDE_QUATERNION_DATA, HEARTBEAT_DATA, HIGHRES_IMU_DATA,
    };

    #[test]
    fn samples_are_turned_to_forward_left_up() {
        let imu = HIGHRES_IMU_DATA {
            time_usec: 7_000_001,
            xgyro: 0.5,
            ygyro: -0.25,
            zgyro: 1.0,
            xacc: 0.0,
            yacc: 0.0,
            zacc: -9.75,
            fields_updated: HighresImuUpdatedFlags::all(),
            ..HIGHRES_IMU_DATA::DEFAULT
        };
        let found = sample(&MavMessage::HIGHRES_IMU(imu.clone()));
        let wanted = AutopilotSample {
            kind: MessageKind::HighresImu,
            time_us: 7_000_001,
            rate: [0.5, 0.25, -1.0],
            specific_force: [0.0, 0.0, 9.75],
        };
        assert_eq!(found, Some(wanted));
        let no_gyroscope =
            HIGHRES_IMU_DATA { fields_updated: HighresImuUpdatedFlags::empty(), ..imu };
        assert_eq!(sample(&MavMessage::HIGHRES_IMU(no_gyroscope)), None);
    }

    #[test]
    fn attitudes_have_rates_and_no_force() {
        let attitude = ATTITUDE_QUATERNION_DATA {
            time_boot_ms: 12,
            rollspeed: 0.5,
            pitchspeed: 0.25,
            yawspeed: -1.0,
            ..ATTITUDE_QUATERNION_DATA::DEFAULT
        };
        let found = sample(&MavMessage::ATTITUDE_QUATERNION(attitude));
        assert!(found.is_some_and(|found| {
            found.kind < MessageKind::HighresImu
                && (found.time_us, found.rate) == (12_000, [0.5, -0.25, 1.0])
                && found.specific_force.iter().all(|force| force.is_nan())
        }));
        assert_eq!(sample(&MavMessage::HEARTBEAT(HEARTBEAT_DATA::DEFAULT)), None);
    }
}
