//! Reports of a swarm for Rust programs, with types in place of JSON.
//!
//! - [`Client`] connects to the drones and receives all their reports.
//! - [`PeerReport`] is one report on one target: poses and covariances as `nalgebra` types, and its
//!   age.
//! - [`SwarmView`] combines all reports into the poses of all drones relative to one of them.
//!
//! ```
//! use std::time::Duration;
//! use flockeye_peer::{Client, PeerReport, SwarmView};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! # // The drone wren, on a port that nobody has. It sees kite.
//! # let port = std::net::TcpListener::bind("127.0.0.1:0")?.local_addr()?.port();
//! # let endpoint = format!("tcp/127.0.0.1:{port}");
//! # let wren = flockeye_network::Network::open(&flockeye_network::NetworkParameters {
//! #     observer: "wren".into(),
//! #     listen: vec![endpoint.clone()],
//! #     ..Default::default()
//! # })?;
//! # let reporter = wren.reporter()?;
//! # let (stamp_utc_ns, _) =
//! #     flockeye_network::utc_from_monotonic(flockeye_network::monotonic_now_ns());
//! # let mut covariance = [0.0; 21];
//! # [0, 6, 11, 15, 18, 20].into_iter().for_each(|k| covariance[k] = 1e-5);
//! # let kite = serde_json::json!({
//! #     "target": "kite", "state": "confirmed", "measured_by": "aligned", "markers": 3,
//! #     "unseen_s": 0.0, "position": [1.5, 0.2, 0.1], "orientation": [0, 0, 0, 1],
//! #     "covariance": covariance, "linear_velocity": [0, 0, 0], "angular_velocity": [0, 0, 0],
//! # });
//! # reporter.report(serde_json::from_value(serde_json::json!({
//! #     "schema": "flockeye.frame/2", "observer": "wren", "frame": 1, "epoch": 0,
//! #     "stamp_utc_ns": stamp_utc_ns, "clock_synchronised": false, "stream_s": 0.0,
//! #     "latency_ms": 0.0, "targets": [kite],
//! # }))?)?;
//! // Where a drone's gateway listens, or a router; and the swarm's name.
//! let client = Client::connect(&[&endpoint], "swarm")?;
//! let reports = client.reports();
//! let mut swarm = SwarmView::from("wren");
//! // Each report as it comes ...
//! let heard = reports.recv_timeout(Duration::from_secs(10)).ok_or("nobody reports")?;
//! let report = PeerReport::from(&heard);
//! let position = report.observer_from_target.a_from_b.translation.vector;
//! println!("{} sees {} at {position}, {:?} old", report.observer, report.target, report.age());
//! swarm.hear(&report);
//! // ... the last one on each target ...
//! assert!(client.last_known("wren", "kite").is_some());
//! // ... and where all are, as wren would have it.
//! for place in swarm.places_now() {
//!     println!("{} is at {}", place.name, place.own_from_drone.a_from_b.translation.vector);
//! }
//! # Ok(())
//! # }
//! ```

mod client;
mod report;
mod swarm;
mod uncertain_pose;

pub use client::Client;
pub use flockeye_network::{NetworkError, ReportStream};
pub use report::{PeerReport, Rival};
pub use swarm::{DronePlace, SwarmView};
pub use uncertain_pose::UncertainPose;
