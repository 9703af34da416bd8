//! Hear a swarm from a Rust program, with types in place of JSON.
//!
//! - [`Client`] links with the drones and hears all their reports.
//! - [`PeerReport`] is one report on one target: poses and covariances as `nalgebra` has them, and its age.
//! - [`SwarmView`] combines all reports into where each drone is from one of them.
//!
//! ```
//! use std::time::Duration;
//! use flockeye_peer::{Client, SwarmView};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! # let drone = flockeye_peer::example::drone()?;
//! # let endpoint = drone.endpoint.as_str();
//! // Where a drone's gateway listens, or a router; and the swarm's name.
//! let client = Client::connect(&[endpoint], "swarm")?;
//! let reports = client.reports();
//! let mut swarm = SwarmView::from("wren");
//! # drone.report()?;
//! // Each report as it comes ...
//! let report = reports.next_within(Duration::from_secs(10)).ok_or("nobody reports")?;
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
#[doc(hidden)]
pub mod example;
mod report;
mod view;

pub use client::{Client, Reports};
pub use flockeye_geometry::swarm::{Place, UncertainPose, Way};
pub use flockeye_network::NetworkError;
pub use report::PeerReport;
pub use view::SwarmView;
