//! Errors of the network.

use flockeye_contract::wire::{MAX_TARGETS, WireError};
use flockeye_identity::{CertificateFault, IdentityError};

impl NetworkError {
    /// A parameter that cannot work.
    pub fn parameter(field: &str, found: &str, reason: impl Into<String>) -> Self {
        Self::Parameter { field: field.into(), found: found.into(), reason: reason.into() }
    }

    /// Whether the error may pass by itself: the clock is not set yet, or a certificate is being
    /// renewed.
    pub fn may_pass(&self) -> bool {
        use CertificateFault::{Expired, NotYet};
        matches!(self, Self::Identity(IdentityError::Certificate { fault: Expired | NotYet, .. }))
    }
}

/// Errors of the network. None of them ends a stage that is already running.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the texts name the fields")]
pub enum NetworkError {
    /// A parameter that cannot work.
    #[error("{field}: '{found}' {reason}")]
    Parameter { field: String, found: String, reason: String },
    /// Keys, certificates or the roster cannot be used.
    #[error("security: {0}")]
    Identity(#[from] IdentityError),
    /// The certificate has another name, or belongs to another swarm.
    #[error(
        "security: the {what} is '{found}', and not '{wanted}'. Cure: flockeye keys issue {wanted}"
    )]
    Another { what: &'static str, found: String, wanted: String },
    /// An address that cannot be listened on.
    #[error(
        "cannot listen on {endpoint}: {source}. Cure: end the process that holds the port \
         (ss -lntup), or name another in listen"
    )]
    Listen { endpoint: String, source: std::io::Error },
    /// An operation of Zenoh failed.
    #[error("Zenoh cannot {what}: {reason}")]
    Zenoh { what: &'static str, reason: String },
    /// A thread could not be started.
    #[error("cannot start the thread {name}: {source}")]
    Thread { name: &'static str, source: std::io::Error },
    /// A report that every listener would refuse.
    #[error("the report is unreadable for others: {0}")]
    Report(#[source] WireError),
    /// A report in another drone's name.
    #[error("the report is in the name of '{found}', not '{own}'")]
    Name { found: String, own: String },
    /// More targets than a listener keeps.
    #[error("report on '{0}': already {MAX_TARGETS} targets, which is the most")]
    TooManyTargets(String),
    /// The session is over.
    #[error("the network session is closed")]
    Closed,
}
