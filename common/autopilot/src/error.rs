//! Errors of the line to the autopilot.

/// Maximum neighbours at once.
pub(crate) const MAX_NEIGHBOURS: usize = 64;

/// Errors of the line to the autopilot. None of them ends a stage that is already running.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the texts name the fields")]
pub enum AutopilotError {
    /// An invalid address.
    #[error("link: '{found}' {reason}")]
    Link { found: String, reason: String },
    /// An invalid state of a neighbour.
    #[error("neighbour '{name}': {field} is {found}, but must be {wanted}")]
    Neighbour { name: String, field: &'static str, found: String, wanted: &'static str },
    /// More neighbours at once than the maximum.
    #[error(
        "neighbour '{0}': {MAX_NEIGHBOURS} others are told of already, which is the most. Cure: report lost \
         neighbours as lost"
    )]
    TooManyNeighbours(String),
    /// A thread could not be started.
    #[error("cannot start the thread {name}: {source}")]
    Thread { name: &'static str, source: std::io::Error },
}
