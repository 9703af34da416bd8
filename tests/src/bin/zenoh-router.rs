//! A Zenoh router like `zenohd`, which runs until it is killed.
//!
//! `zenoh-router FILE` reads its configuration from a file. `zenoh-router ENDPOINT [HZ KEY...]`
//! limits the rate of messages with each of these keys on each link. A rule of Zenoh limits all
//! matching keys together, so each key has a rule of its own.

use std::path::Path;

use anyhow::{Context, anyhow};
use zenoh::{Config, Wait};

fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let endpoint = arguments.next().context("where does it listen?")?;
    let config = if Path::new(&endpoint).is_file() {
        Config::from_file(&endpoint)
    } else {
        Config::from_json5(&config(&endpoint, arguments)?.to_string())
    };
    let config = config.map_err(|error| anyhow!("{error}"))?;
    let _session = zenoh::open(config).wait().map_err(|error| anyhow!("{error}"))?;
    loop {
        std::thread::park();
    }
}

fn config(
    endpoint: &str,
    mut arguments: impl Iterator<Item = String>,
) -> anyhow::Result<serde_json::Value> {
    let rate_hz = arguments.next().map(|text| text.parse::<f64>()).transpose()?;
    let mut config = serde_json::json!({
        "mode": "router",
        "listen": { "endpoints": [endpoint] },
        "scouting": { "multicast": { "enabled": false } },
    });
    if let Some(rate_hz) = rate_hz {
        let rule = |key| serde_json::json!({ "key_expr": key, "freq": rate_hz });
        config["downsampling"] = serde_json::json!([{
            "flows": ["egress"],
            "messages": ["put"],
            "rules": arguments.map(rule).collect::<Vec<_>>(),
        }]);
    }
    Ok(config)
}
