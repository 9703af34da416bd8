//! What goes over the network.

use std::path::PathBuf;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// What goes over the network.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Gateway {
    /// false: nothing leaves this drone, to the swarm, to ROS 2 or to the autopilot.
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
    /// Maximum frames a second that are reported to the swarm; left out: all of them. ROS 2 and the autopilot get
    /// all of them.
    #[schemars(range(min = 1.0, max = 1000.0))]
    pub report_hz: Option<f64>,
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
        }
    }
}
