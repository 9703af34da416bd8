//! What Flockeye sends to other drones, and receives from them, over Zenoh.
//!
//! - [`Network`]: one Zenoh session, opened from [`NetworkParameters`]. Opening never waits for a
//!   neighbour to be there.
//! - [`Reporter`]: publishes that this drone is alive and where it sees its neighbours. It never makes
//!   its caller wait for the radio.
//! - [`Listener`]: keeps a table of who is alive and what each of them sees ([`Peers`]), and hands
//!   out each report as it arrives ([`ReportStream`]).
//! - Secure sessions: [`flockeye_identity`] says who is who. Links are mutual TLS, reports are signed, and `access.rs` has
//!   the rules of each link.
//! - [`endpoint`]: whether a text can be an endpoint.
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
