//! What goes over the network.

use std::path::PathBuf;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// What goes over the network.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Gateway {
    /// false: nothing goes over the network.
    pub enabled: bool,
    /// How it is linked with the others.
    pub mode: GatewayMode,
    /// Zenoh endpoints to listen on (`tcp/192.168.1.7:7447`), each on a named interface's address. Not used
    /// by a client.
    pub listen: Vec<String>,
    /// Zenoh endpoints to connect to.
    pub connect: Vec<String>,
    /// Interface on which peers are looked for by multicast; left out: they are not.
    pub scout_interface: Option<String>,
    /// The files by which members of the swarm know each other; left out: anybody who can link can say anything.
    pub security: Option<Security>,
    /// true: without `security` it may be linked with others than this machine.
    pub unsecured: bool,
    /// At most so many frames a second are reported to the swarm; left out: all of them. ROS 2 and the autopilot
    /// are told of all.
    #[schemars(range(min = 1.0, max = 1000.0))]
    pub report_hz: Option<f64>,
    /// How ROS 2 is told too; left out: it is not.
    pub ros2: Option<Ros2>,
    /// How the drone's autopilot is told too; left out: it is not.
    pub autopilot: Option<Autopilot>,
}

/// How a gateway is linked with the others (docs/PEERS.md).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum GatewayMode {
    /// With each of them directly.
    #[default]
    Peer,
    /// Through a router alone: that of the first `connect` endpoint that answers.
    Client,
}

/// A member's files, as `flockeye keys issue` writes them (docs/SECURITY.md).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Security {
    /// The certificate of the swarm's authority.
    pub ca: PathBuf,
    /// This drone's certificate, in the name of `observer.name`.
    pub certificate: PathBuf,
    /// Its private key, readable by its owner alone.
    pub key: PathBuf,
    /// Who belongs to the swarm, signed by the authority.
    pub roster: PathBuf,
}

/// How the autopilot is told where neighbours are (docs/AUTOPILOT.md).
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
    /// Most often that the target is told, each second; 0: never.
    #[schemars(range(min = 0.0, max = 100.0))]
    pub target_hz: f64,
    /// Most often that obstacles are told, each second; 0: never.
    #[schemars(range(min = 0.0, max = 100.0))]
    pub obstacles_hz: f64,
    /// How often the autopilot is asked to send its odometry, each second; 0: it is not asked.
    #[schemars(range(min = 0.0, max = 100.0))]
    pub odometry_hz: f64,
    /// A neighbour that was last seen longer ago is not told, milliseconds.
    #[schemars(range(min = 50, max = 5000))]
    pub max_age_ms: u32,
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
            max_age_ms: 500,
            obstacle_range_m: [0.0, 50.0],
        }
    }
}

/// How ROS 2 nodes that use `rmw_zenoh` are reached (docs/ROS2.md).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Ros2 {
    /// The ROS domain, as the nodes have it in `ROS_DOMAIN_ID`.
    #[schemars(range(min = 0, max = 232))]
    pub domain: u32,
    /// Routers to connect to; the first that answers is used.
    pub connect: Vec<String>,
    /// What all topics but `/tf` are below, such as `/swarm`; empty: nothing.
    pub namespace: String,
}

impl Default for Ros2 {
    fn default() -> Self {
        Self { domain: 0, connect: vec!["tcp/127.0.0.1:7447".into()], namespace: String::new() }
    }
}

impl Default for Gateway {
    fn default() -> Self {
        Self {
            enabled: true,
            mode: GatewayMode::Peer,
            listen: vec!["tcp/127.0.0.1:7447".into()],
            connect: Vec::new(),
            scout_interface: None,
            security: None,
            unsecured: false,
            report_hz: None,
            ros2: None,
            autopilot: None,
        }
    }
}
