//! What is offered to Prometheus.

use std::net::SocketAddr;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// What the launcher offers to Prometheus: docs/OPERATING.md.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Metrics {
    /// Address and port (`127.0.0.1:9464`); left out: nothing is offered. Whoever reaches it can read it.
    #[schemars(with = "Option<String>")]
    pub listen: Option<SocketAddr>,
}
