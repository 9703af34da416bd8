//! Structured logs, and warnings that are not repeated on every frame.
//!
//! Levels: `error`: the stage cannot go on. `warn`: something was lost, or will be. `info`: once in a
//! process's life. `debug`: now and then. `trace`: each frame.

use std::io::IsTerminal;
use std::time::{Duration, Instant};

use tracing_subscriber::EnvFilter;

/// Sends logs to standard error. `RUST_LOG` says which (`info` of Flockeye's own by default).
///
/// A second call changes nothing.
pub fn init() {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| {
        EnvFilter::new("info,zenoh=error,wgpu_hal=error,wgpu_core=error,naga=error")
    });
    let subscriber = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .with_target(false)
        .with_ansi(std::io::stderr().is_terminal());
    // The launcher puts its own time before each stage's lines.
    let outcome = if std::env::var_os(crate::instance::STAGE_VARIABLE).is_some() {
        subscriber.without_time().try_init()
    } else {
        subscriber.try_init()
    };
    // Already set by an earlier call in this process (tests): that one stays.
    drop(outcome);
}

/// Lets one event through in each period, and counts the events that it suppressed.
///
/// ```
/// # use flockeye_runtime::logs::Throttle;
/// let mut throttle = Throttle::default();
/// assert_eq!(throttle.admit(), Some(0));
/// assert_eq!(throttle.admit(), None);
/// ```
#[derive(Debug, Clone)]
pub struct Throttle {
    period: Duration,
    last: Option<Instant>,
    held_back: u64,
}

impl Default for Throttle {
    fn default() -> Self {
        Self { period: Duration::from_secs(5), last: None, held_back: 0 }
    }
}

impl Throttle {
    /// If this event is let through: the number of events suppressed since the last one.
    pub fn admit(&mut self) -> Option<u64> {
        let now = Instant::now();
        if self.last.is_some_and(|last| now - last < self.period) {
            self.held_back += 1;
            return None;
        }
        self.last = Some(now);
        Some(std::mem::take(&mut self.held_back))
    }
}
