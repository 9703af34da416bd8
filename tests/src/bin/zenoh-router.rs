//! A Zenoh router, as `zenohd` is one: `zenoh-router ENDPOINT [HZ KEY...]`, until it is killed. It passes what is
//! published under each of these keys on over each link at most so often.
//!
//! A rule of Zenoh counts all that its key expression matches together. So each key has a rule of its own.

use anyhow::{Context, anyhow};
use zenoh::Wait;

fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let endpoint = arguments.next().context("where does it listen?")?;
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
    let config =
        zenoh::Config::from_json5(&config.to_string()).map_err(|error| anyhow!("{error}"))?;
    let _session = zenoh::open(config).wait().map_err(|error| anyhow!("{error}"))?;
    loop {
        std::thread::park();
    }
}
