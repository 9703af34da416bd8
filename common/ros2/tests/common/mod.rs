//! What the tests with real sessions share.

#![allow(clippy::unwrap_used, clippy::expect_used, dead_code, unused_imports)]

pub(crate) use flockeye_require::loopback::*;
use flockeye_ros2::{ObserverSeen, RelativePose, Ros2Parameters};
use zenoh::{Session, Wait};

/// A node that connects to a router at `port`, in domain 3.
pub(crate) fn parameters(port: u16) -> Ros2Parameters {
    Ros2Parameters { domain: 3, connect: vec![tcp(port)], ..Default::default() }
}

/// A session that is not ours, without multicast, as rmw_zenoh's are.
pub(crate) fn session(mode: &str, listen: Option<u16>, connect: Option<u16>) -> Session {
    let endpoints =
        |port: Option<u16>| port.map(|port| format!("\"{}\"", tcp(port))).unwrap_or_default();
    let config = format!(
        r#"{{ mode: "{mode}", listen: {{ endpoints: [{}] }}, connect: {{ endpoints: [{}] }},
             scouting: {{ multicast: {{ enabled: false }} }} }}"#,
        endpoints(listen),
        endpoints(connect)
    );
    zenoh::open(zenoh::Config::from_json5(&config).unwrap()).wait().unwrap()
}

/// A router at `port`, as rmw_zenohd is.
pub(crate) fn router(port: u16) -> Session {
    session("router", Some(port), None)
}

/// Where the observer sees `name`, or is seen by it.
pub(crate) fn neighbour(name: &str) -> RelativePose {
    RelativePose {
        name: name.into(),
        stamp_utc_ns: 1_700_000_000_000_000_123,
        position: [1.0, -2.0, 0.5],
        orientation: [0.0, 0.0, 0.6, 0.8],
        covariance: std::array::from_fn(|k| k as f64 / 1024.0),
    }
}

/// Where `peer` sees the observer, which flies to the peer's left at 2 m/s.
pub(crate) fn seen(peer: &str) -> ObserverSeen {
    let (linear_velocity, angular_velocity) = ([0.0, 2.0, 0.0], [0.0, 0.0, 0.1]);
    ObserverSeen { pose: neighbour(peer), linear_velocity, angular_velocity }
}
