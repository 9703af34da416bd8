//! Everything Flockeye says to other drones, and hears from them, over Zenoh.
//!
//! - [`Network`]: one Zenoh session, opened from [`NetworkParameters`]. Opening never waits for a
//!   neighbour to be there.
//! - [`Reporter`]: says that this drone is alive and where it sees whom. It never makes its caller
//!   wait for the radio.
//! - [`Listener`]: keeps a table of who is alive and what each of them sees ([`Peers`]), and hands
//!   out each report as it arrives ([`ReportStream`]).
//! - [`utc_from_monotonic`]: the stamp that goes into a report.
//!
//! What the bytes mean is in [`flockeye_contract::wire`]; `docs/PEERS.md` says the same to writers
//! of subscribers in other languages.

mod configured;
mod connection;
mod error;
mod listener;
mod lock;
mod outbox;
mod parameters;
mod peers;
mod reporter;
mod session;
mod stream;
mod utc;

pub use error::{MAX_TARGETS, NetworkError};
pub use listener::Listener;
pub use parameters::{NetworkMode, NetworkParameters};
pub use peers::{MAX_OBSERVERS, PeerState, Peers, Received, Refusal, age_of};
pub use reporter::{Reporter, ReporterCounters};
pub use session::Network;
pub use stream::{Heard, ReportStream};
pub use utc::utc_from_monotonic;
