//! The drone's autopilot.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// How the drone's autopilot gets the neighbours' poses (docs/AUTOPILOT.md).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Autopilot {
    /// Where the autopilot is: `udpin:ADDRESS:PORT` to listen, `udpout:HOST:PORT` to send to, or
    /// `serial:DEVICE:BAUD`.
    pub link: String,
    /// The neighbour that it follows (`TARGET_RELATIVE`); left out: none. All neighbours are obstacles.
    pub target: Option<String>,
    /// The vehicle's MAVLink system: the autopilot's `MAV_SYS_ID` or `SYSID_THISMAV`.
    #[schemars(range(min = 1, max = 255))]
    pub system_id: u8,
    /// Our component in that system; 191 is an onboard computer.
    #[schemars(range(min = 2, max = 255))]
    pub component_id: u8,
    /// Maximum rate of the target's poses, each second; 0: never.
    #[schemars(range(min = 0.0, max = 100.0))]
    pub target_hz: f64,
    /// Maximum rate of obstacles, each second; 0: never.
    #[schemars(range(min = 0.0, max = 100.0))]
    pub obstacles_hz: f64,
    /// How often the autopilot is asked to send its odometry, each second; 0: it is not asked.
    #[schemars(range(min = 0.0, max = 100.0))]
    pub odometry_hz: f64,
    /// Nearest and farthest distance at which a neighbour is an obstacle, metres.
    pub obstacle_range_m: [f64; 2],
}

impl Default for Autopilot {
    fn default() -> Self {
        Self {
            link: "udpin:127.0.0.1:14540".into(),
            target: None,
            system_id: 1,
            component_id: 191,
            target_hz: 20.0,
            obstacles_hz: 15.0,
            odometry_hz: 30.0,
            obstacle_range_m: [0.0, 50.0],
        }
    }
}
