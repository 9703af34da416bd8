//! When a run has begun, and when it has had its time.

use std::time::{Duration, Instant};

/// When a run and its source were started.
#[derive(Debug, Clone, Copy)]
pub(super) struct RunTimes {
    /// When the run was started.
    pub started: Instant,
    /// When the source was started.
    pub source_started: Option<Instant>,
    /// How long the source runs; `None`: until somebody ends the run.
    duration: Option<Duration>,
}

impl RunTimes {
    /// A run that starts now.
    pub(super) fn new(duration: Option<Duration>) -> Self {
        Self { started: Instant::now(), source_started: None, duration }
    }

    /// Notes that the source starts now.
    pub(super) fn note_source_start(&mut self) {
        self.source_started = Some(Instant::now());
    }

    /// Whether the source has run for as long as was asked for.
    pub(super) fn is_over(&self) -> bool {
        self.duration.is_some_and(|duration| self.source_has_run(duration))
    }

    /// Whether the source was started this long ago.
    pub(super) fn source_has_run(&self, time: Duration) -> bool {
        self.source_started.is_some_and(|start| start.elapsed() >= time)
    }
}
