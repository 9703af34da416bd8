//! Reports to and from other drones, over Zenoh.
//!
//! - [`Network`]: one Zenoh session, opened from [`NetworkParameters`]. Opening never waits for a
//!   neighbour to be there.
//! - [`Reporter`]: publishes that this drone is alive, and its sightings of neighbours. It never
//!   blocks its caller for the radio.
//! - [`Listener`]: keeps a table of the drones that are alive and their sightings ([`Peers`]). It
//!   passes on each report as it arrives ([`ReportStream`]).
//! - Secure sessions: [`flockeye_identity`] has the members' identities. Links are mutual TLS,
//!   reports are signed, and `access.rs` has the rules of each link.
//! - [`endpoint`]: checks of endpoints.
//! - [`utc_from_monotonic`]: the time stamp of a report.
//!
//! The format is in [`flockeye_contract::wire`]; `docs/PEERS.md` describes it for subscribers in
//! other languages.

mod access;
mod clock;
mod configured;
mod connection;
pub mod endpoint;
mod error;
mod freshness;
mod listener;
mod outbox;
mod parameters;
mod peers;
mod refusal;
mod refused_links;
mod reporter;
mod session;
mod stream;
mod utc;
mod waiting;

pub use clock::ClockEstimate;
pub use connection::{open_session, spawn};
pub use error::NetworkError;
pub use freshness::ClockReading;
pub use listener::Listener;
pub use parameters::{NetworkMode, NetworkParameters, router_config};
pub use peers::{LatestSighting, PeerState, Peers};
pub use refusal::Refused;
pub use reporter::{Reporter, SendCounters};
pub use session::Network;
pub use stream::{ReportStream, TimedSighting};
pub use utc::{monotonic_now_ns, utc_from_monotonic};
