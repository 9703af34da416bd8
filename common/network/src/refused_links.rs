//! Links that Zenoh has refused, because the other end showed no certificate of the swarm. Zenoh
//! reports them only in its log, so its log lines are captured.

use std::sync::{Arc, OnceLock};

use flockeye_runtime::logs::{Overheard, overhear};

/// End of Zenoh's log line, the same for every reason.
const HINT: &str = ". Hint: increase the system open file limit.";

/// Number of links that this process has refused, and the reason for the last refusal.
pub(crate) fn refused_links() -> (u64, String) {
    let (count, line) = log().heard();
    (count, line.strip_suffix(HINT).unwrap_or(&line).to_owned())
}

/// Starts to capture the log lines, once for all sessions of a process.
pub(crate) fn log() -> &'static Arc<Overheard> {
    static LOG: OnceLock<Arc<Overheard>> = OnceLock::new();
    LOG.get_or_init(|| overhear("zenoh_link_tls", HINT))
}
