//! Timeouts of the line.

use std::io;
use std::time::Duration;

/// Maximum time for which reading or writing blocks.
pub(super) const TIMEOUT: Duration = Duration::from_millis(100);
/// Silence after which the autopilot may have another address, because autopilots send heartbeats
/// each second.
pub(crate) const SILENT: Duration = Duration::from_secs(3);

/// Whether the error is a timeout.
pub(super) fn is_timeout(error: &io::Error) -> bool {
    use io::ErrorKind::{Interrupted, TimedOut, WouldBlock};
    matches!(error.kind(), TimedOut | WouldBlock | Interrupted)
}
