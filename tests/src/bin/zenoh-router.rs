//! A Zenoh router, as `zenohd` is one: `zenoh-router ENDPOINT`, until it is killed.

use anyhow::{Context, anyhow};
use zenoh::Wait;

fn main() -> anyhow::Result<()> {
    let endpoint = std::env::args().nth(1).context("where does it listen?")?;
    let config = serde_json::json!({
        "mode": "router",
        "listen": { "endpoints": [endpoint] },
        "scouting": { "multicast": { "enabled": false } },
    });
    let config =
        zenoh::Config::from_json5(&config.to_string()).map_err(|error| anyhow!("{error}"))?;
    let _session = zenoh::open(config).wait().map_err(|error| anyhow!("{error}"))?;
    loop {
        std::thread::park();
    }
}
