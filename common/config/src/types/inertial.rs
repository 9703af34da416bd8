//! The observer's inertial sensor, as types.

use std::path::PathBuf;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::MavlinkAddress;

/// This drone's inertial sensor. Nothing needs one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Inertial {
    /// `none`, `sim` (that of the simulated world), `mavlink:udp:ADDRESS:PORT` to listen on,
    /// `mavlink:udpout:HOST:PORT` to speak to, `mavlink:serial:DEVICE:BAUD`, `recording` (that of the recorded flight
    /// that is played), or a CSV file beside a video (columns t_s, gx, gy, gz, ax, ay, az).
    pub source: String,
    /// false: its samples are recorded and not used.
    pub used: bool,
    /// Turns the sensor's axes into the camera's: unit quaternion x, y, z, w. `flockeye calibrate imu` finds
    /// it.
    pub camera_from_sensor: [f64; 4],
    /// What has to be added to the sensor's time to get the camera's, milliseconds. `flockeye calibrate imu`
    /// finds it.
    #[schemars(range(min = -1000.0, max = 1000.0))]
    pub time_offset_ms: f64,
}

impl Default for Inertial {
    fn default() -> Self {
        Self {
            source: "none".into(),
            used: true,
            camera_from_sensor: [0.0, 0.0, 0.0, 1.0],
            time_offset_ms: 0.0,
        }
    }
}

/// Where samples of the inertial sensor come from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum InertialSource {
    /// There is none.
    None,
    /// The simulated world has one.
    Simulated,
    /// A CSV file beside a recording.
    Recorded(PathBuf),
    /// The recording of a flight that is played.
    Recording,
    /// An autopilot.
    Mavlink(MavlinkAddress),
}

impl Inertial {
    /// What [`Self::source`] names.
    ///
    /// # Errors
    /// What is wrong with it, and what would be right.
    pub fn parsed_source(&self) -> Result<InertialSource, String> {
        let wrong = |what: &str| Err(format!("'{}' {what}", self.source));
        match self.source.as_str() {
            "none" | "" => return Ok(InertialSource::None),
            "sim" => return Ok(InertialSource::Simulated),
            "recording" => return Ok(InertialSource::Recording),
            _ => {}
        }
        const BEFORE: &str = "mavlink:";
        let Some(address) = self.source.strip_prefix(BEFORE) else {
            return match self.source.ends_with(".csv") {
                true => Ok(InertialSource::Recorded(self.source.clone().into())),
                false => wrong(
                    "is no inertial sensor: use none, sim, recording, mavlink:.., or FILE.csv",
                ),
            };
        };
        match MavlinkAddress::parse_after(BEFORE, address) {
            Ok(address) => Ok(InertialSource::Mavlink(address)),
            Err(reason) => wrong(&reason),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(source: &str) -> Result<InertialSource, String> {
        Inertial { source: source.into(), ..Inertial::default() }.parsed_source()
    }

    #[test]
    fn sources_are_told_apart() {
        assert_eq!(parsed("none"), Ok(InertialSource::None));
        assert_eq!(parsed("sim"), Ok(InertialSource::Simulated));
        assert_eq!(parsed("recording"), Ok(InertialSource::Recording));
        assert_eq!(parsed("a/imu.csv"), Ok(InertialSource::Recorded("a/imu.csv".into())));
        let udp = MavlinkAddress::UdpIn(([0, 0, 0, 0], 14550).into());
        assert_eq!(parsed("mavlink:udp:0.0.0.0:14550"), Ok(InertialSource::Mavlink(udp)));
        let serial = MavlinkAddress::Serial { device: "/dev/ttyACM0".into(), baud: 921_600 };
        assert_eq!(
            parsed("mavlink:serial:/dev/ttyACM0:921600"),
            Ok(InertialSource::Mavlink(serial))
        );
    }

    #[test]
    fn wrong_sources_say_what_is_right() {
        for (source, cure) in [
            ("imu.txt", "FILE.csv"),
            ("mavlink:udp:14550", "mavlink:udp:0.0.0.0:14550"),
            ("mavlink:serial:/dev/ttyACM0", "921600"),
            ("mavlink:serial::5", "921600"),
            ("mavlink:can:0", "mavlink:serial"),
        ] {
            assert!(parsed(source).is_err_and(|error| error.contains(cure)), "{source}");
        }
    }
}
