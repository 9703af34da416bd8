//! What can go wrong with the autopilot.

/// The most neighbours at once.
pub(crate) const MAX_NEIGHBOURS: usize = 64;

/// What can go wrong with the autopilot. None of these ends a stage that is already running.
#[derive(Debug, thiserror::Error)]
pub enum AutopilotError {
    /// An address that is none.
    #[error("link: '{found}' {reason}")]
    Link {
        /// The address.
        found: String,
        /// Why it cannot work, and what would.
        reason: String,
    },
    /// A neighbour's state that no autopilot could use.
    #[error("neighbour '{name}': {field} is {found}, but must be {wanted}")]
    Neighbour {
        /// The neighbour's name.
        name: String,
        /// Which part of its state.
        field: &'static str,
        /// What it holds.
        found: String,
        /// What would be right.
        wanted: &'static str,
    },
    /// More neighbours at once than there are numbers for.
    #[error(
        "neighbour '{0}': {MAX_NEIGHBOURS} others are told of already, which is the most. Cure: report lost \
         neighbours as lost"
    )]
    TooManyNeighbours(String),
    /// A thread could not be started.
    #[error("cannot start the thread {name}: {source}")]
    Thread {
        /// Its name.
        name: &'static str,
        /// What the system says.
        source: std::io::Error,
    },
}
