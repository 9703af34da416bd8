//! How long is waited, and whether somebody has waited so long.

use std::io;
use std::time::Duration;

/// The longest that reading or writing blocks.
pub(super) const TIMEOUT: Duration = Duration::from_millis(100);
/// An autopilot that is silent for so long may speak from elsewhere: they send heartbeats each
/// second.
pub(crate) const SILENT: Duration = Duration::from_secs(3);

/// Whether nothing came in that time.
pub(super) fn is_timeout(error: &io::Error) -> bool {
    use io::ErrorKind::{Interrupted, TimedOut, WouldBlock};
    matches!(error.kind(), TimedOut | WouldBlock | Interrupted)
}
