//! Ctrl-C and similar signals.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use anyhow::Context;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};

/// A flag that SIGINT, SIGTERM and SIGHUP raise.
///
/// # Errors
/// The system does not let signals be caught.
pub fn stop_flag() -> anyhow::Result<Arc<AtomicBool>> {
    let stopping = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM, SIGHUP] {
        signal_hook::flag::register(signal, stopping.clone()).context("cannot catch signals")?;
    }
    Ok(stopping)
}
