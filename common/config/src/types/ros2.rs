//! ROS 2.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// How ROS 2 nodes that use `rmw_zenoh` are reached (docs/PEERS.md).
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
