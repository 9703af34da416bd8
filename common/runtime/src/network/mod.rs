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

mod connection;
mod listener;
mod outbox;
mod parameters;
mod peers;
mod reporter;
mod stream;
mod utc;

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use flockeye_contract::wire::WireError;

pub use listener::Listener;
pub use parameters::{NetworkMode, NetworkParameters};
pub use peers::{MAX_OBSERVERS, PeerState, Peers, Received, Refusal, age_of};
pub use reporter::{Reporter, ReporterCounters};
pub use stream::{Heard, ReportStream};
pub use utc::utc_from_monotonic;

use connection::Connection;

/// Most targets that one observer reports on.
pub const MAX_TARGETS: usize = 64;

/// What can go wrong with the network. None of these ends a stage that is already running.
#[derive(Debug, thiserror::Error)]
pub enum NetworkError {
    /// A parameter that cannot work.
    #[error("{field}: '{found}' {reason}")]
    Parameter {
        /// Name of the field, with its index in a list.
        field: String,
        /// What it holds.
        found: String,
        /// Why it cannot work, and what would.
        reason: String,
    },
    /// An address that cannot be listened on.
    #[error(
        "cannot listen on {endpoint}: {source}. Cure: end the process that holds the port \
         (ss -lntup), or name another in listen"
    )]
    Listen {
        /// The endpoint as configured.
        endpoint: String,
        /// What the system says.
        source: std::io::Error,
    },
    /// Zenoh refused.
    #[error("Zenoh cannot {what}: {reason}")]
    Zenoh {
        /// What was asked of it.
        what: &'static str,
        /// What it says.
        reason: String,
    },
    /// A thread could not be started.
    #[error("cannot start the thread {name}: {source}")]
    Thread {
        /// Its name.
        name: &'static str,
        /// What the system says.
        source: std::io::Error,
    },
    /// A report that no listener would accept.
    #[error("report on '{target}' is unreadable for others: {source}")]
    Report {
        /// The report's target.
        target: String,
        /// What a listener would say.
        source: WireError,
    },
    /// A report with a name that cannot stand in a key, or in somebody else's name.
    #[error("report on '{target}': {reason}")]
    Name {
        /// The report's target.
        target: String,
        /// Which name, and why not.
        reason: String,
    },
    /// More targets than a listener keeps.
    #[error("report on '{target}': already {MAX_TARGETS} targets, which is the most")]
    TooManyTargets {
        /// The report's target.
        target: String,
    },
    /// The session is over.
    #[error("the network session is closed")]
    Closed,
}

/// A Zenoh session. [`Reporter`]s and [`Listener`]s made from it keep it open by themselves, so
/// they may outlive this value.
#[derive(Debug)]
pub struct Network {
    swarm: String,
    observer: String,
    connection: Arc<Connection>,
}

impl Network {
    /// Opens a session. Peers and routers are ready on return, within a few hundred milliseconds
    /// whether or not anybody is there; a client, which cannot exist without its router, goes on
    /// trying in the background. Lost links are restored in the background too.
    ///
    /// # Errors
    /// [`NetworkError::Parameter`] and [`NetworkError::Listen`] say what to change. An address of
    /// an interface that is not up yet is no error: it is listened on once it is there.
    pub fn open(parameters: &NetworkParameters) -> Result<Self, NetworkError> {
        parameters.check()?;
        Ok(Self {
            swarm: parameters.swarm.clone(),
            observer: parameters.observer.clone(),
            connection: Connection::open(parameters)?,
        })
    }

    /// Says to the swarm that this drone is alive, until the reporter is dropped.
    ///
    /// # Errors
    /// [`NetworkError::Thread`].
    pub fn reporter(&self) -> Result<Reporter, NetworkError> {
        Reporter::start(self.connection.clone(), &self.swarm, &self.observer)
    }

    /// Hears everybody in the swarm, this session's own reporter included.
    ///
    /// # Errors
    /// [`NetworkError::Thread`].
    pub fn listener(&self) -> Result<Listener, NetworkError> {
        Listener::start(self.connection.clone(), &self.swarm)
    }

    /// Whether the session is open. Only a client can be without one, while it looks for its
    /// router.
    pub fn is_open(&self) -> bool {
        self.connection.is_open()
    }
}

/// Locks `mutex`. What it guards here is whole between any two statements, so a thread that
/// panicked while it held the lock leaves nothing half done.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
