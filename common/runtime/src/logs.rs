//! Structured logs, and warnings that are not repeated on every frame.
//!
//! Levels: `error`: the stage cannot go on. `warn`: something was lost, or will be. `info`: once in
//! a process's life. `debug`: now and then. `trace`: each frame.

use std::fmt::{Debug, Write};
use std::io::IsTerminal;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use tracing::field::Field;
use tracing::{Event, Subscriber};
use tracing_subscriber::filter::LevelFilter;
use tracing_subscriber::layer::{Context, SubscriberExt};
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Layer};

use crate::lock::lock;

/// Sends logs to standard error. `RUST_LOG` chooses which (`info` of Flockeye's own by default).
///
/// A second call changes nothing.
pub fn init() {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| {
        EnvFilter::new("info,zenoh=error,wgpu_hal=error,wgpu_core=error,naga=error")
    });
    let lines = tracing_subscriber::fmt::layer()
        .with_writer(std::io::stderr)
        .with_target(false)
        .with_ansi(std::io::stderr().is_terminal());
    // The launcher adds its own time before each stage's lines.
    let lines = if std::env::var_os(crate::instance::STAGE_VARIABLE).is_some() {
        lines.without_time().boxed()
    } else {
        lines.boxed()
    };
    // Warnings that are only counted need no printing.
    let outcome = tracing_subscriber::registry()
        .with(lines.with_filter(filter))
        .with(Overhearing.with_filter(LevelFilter::WARN))
        .try_init();
    // An earlier call in this process (tests) has set the subscriber, which stays.
    drop(outcome);
}

/// Counter of a library's warnings that are reported only in its log.
#[derive(Debug)]
pub struct Overheard {
    target: &'static str,
    contains: &'static str,
    heard: Mutex<(u64, String)>,
}

static OVERHEARD: Mutex<Vec<Arc<Overheard>>> = Mutex::new(Vec::new());

/// Counts, from now on, the warnings of modules that begin with `target` and that contain this
/// text. It needs the logs of [`init`].
pub fn overhear(target: &'static str, contains: &'static str) -> Arc<Overheard> {
    let overheard = Arc::new(Overheard { target, contains, heard: Mutex::default() });
    lock(&OVERHEARD).push(overheard.clone());
    overheard
}

impl Overheard {
    /// Number of these warnings, and the last one.
    pub fn heard(&self) -> (u64, String) {
        lock(&self.heard).clone()
    }
}

/// Layer of the log that feeds [`overhear`].
struct Overhearing;

impl<S: Subscriber> Layer<S> for Overhearing {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        let target = event.metadata().target();
        let is_wanted = |overheard: &&Arc<Overheard>| target.starts_with(overheard.target);
        // Copied before use, because formatting the event may run foreign code.
        let wanted: Vec<_> = lock(&OVERHEARD).iter().filter(is_wanted).cloned().collect();
        for overheard in wanted {
            let mut text = String::new();
            event.record(&mut |field: &Field, value: &dyn Debug| {
                if field.name() == "message" {
                    // Writing to a String cannot fail.
                    let _ = write!(text, "{value:?}");
                }
            });
            if text.contains(overheard.contains) {
                let mut heard = lock(&overheard.heard);
                *heard = (heard.0 + 1, text);
            }
        }
    }
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
