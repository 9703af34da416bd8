//! What can go wrong with the network.

use flockeye_contract::wire::{MAX_TARGETS, WireError};
use flockeye_identity::{CertificateFault, IdentityError};

impl NetworkError {
    /// A parameter that cannot work.
    pub fn parameter(field: &str, found: &str, reason: impl Into<String>) -> Self {
        Self::Parameter { field: field.into(), found: found.into(), reason: reason.into() }
    }

    /// Whether waiting may help: the clock is not set yet, or a certificate is being renewed.
    pub fn may_pass(&self) -> bool {
        use CertificateFault::{Expired, NotYet};
        matches!(self, Self::Identity(IdentityError::Certificate { fault: Expired | NotYet, .. }))
    }
}

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
    /// Keys, certificates or the roster cannot be used.
    #[error("security: {0}")]
    Identity(#[from] IdentityError),
    /// The certificate is in another name, or of another swarm.
    #[error(
        "security: the {what} is '{found}', and not '{wanted}'. Cure: flockeye keys issue {wanted}"
    )]
    Another {
        /// Which name: the certificate's or the swarm's.
        what: &'static str,
        /// What it says.
        found: String,
        /// What it must say.
        wanted: String,
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
    #[error("the report is unreadable for others: {0}")]
    Report(#[source] WireError),
    /// A report in somebody else's name.
    #[error("the report is in the name of '{found}', not '{own}'")]
    Name {
        /// The observer in the report.
        found: String,
        /// The drone's own name.
        own: String,
    },
    /// More targets than a listener keeps.
    #[error("report on '{0}': already {MAX_TARGETS} targets, which is the most")]
    TooManyTargets(String),
    /// The session is over.
    #[error("the network session is closed")]
    Closed,
}
