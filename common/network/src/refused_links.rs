//! Links that Zenoh has refused, because the other end showed no certificate of the swarm. Zenoh
//! tells its log alone of them, so the log is listened to.

use std::sync::{Arc, OnceLock};

use flockeye_runtime::logs::{Overheard, overhear};

/// How Zenoh's line ends whatever the reason was.
const HINT: &str = ". Hint: increase the system open file limit.";

/// How many links this process has refused, and why it refused the last one.
pub(crate) fn refused_links() -> (u64, String) {
    let (count, line) = log().heard();
    (count, line.strip_suffix(HINT).unwrap_or(&line).to_owned())
}

/// Begins to listen; all sessions of a process share it.
pub(crate) fn log() -> &'static Arc<Overheard> {
    static LOG: OnceLock<Arc<Overheard>> = OnceLock::new();
    LOG.get_or_init(|| overhear("zenoh_link_tls", HINT))
}
