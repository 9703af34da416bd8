//! Counters and latency quantiles of a stage, and their report.

use std::cell::{Cell, RefCell};
use std::rc::Rc;
use std::time::Duration;

use flockeye_contract::{Health, StageState, Text};
use flockeye_geometry::statistics::{median, quantile};

use crate::clock;
use crate::logs::Throttle;

/// Counters of a stage. Ports and the stage itself share one.
#[derive(Debug, Default)]
pub struct Counters {
    taken: Cell<u64>,
    published: Cell<u64>,
    dropped: Cell<u64>,
    failed: Cell<u64>,
    queued: Cell<u64>,
    latencies_ns: RefCell<Vec<i64>>,
    state: Cell<Option<StageState>>,
    /// Start of the absence of a linked component.
    missing_since_ns: Cell<Option<i64>>,
    detail: RefCell<String>,
}

/// Absence of a linked component after which the stage is degraded, nanoseconds.
const MISSING_NS: i64 = 5_000_000_000;

/// Latencies kept between two reports; further ones are not sampled.
const MAX_LATENCIES: usize = 4_096;

impl Counters {
    /// Counts messages that were received.
    pub(crate) fn add_taken(&self, count: u64) {
        self.taken.set(self.taken.get() + count);
    }

    /// Counts messages that were published.
    pub fn add_published(&self, count: u64) {
        self.published.set(self.published.get() + count);
    }

    /// Counts messages that newer ones replaced, or that were abandoned.
    pub fn add_dropped(&self, count: u64) {
        self.dropped.set(self.dropped.get() + count);
    }

    /// Counts messages that were refused or could not be processed.
    pub fn add_failed(&self, count: u64) {
        self.failed.set(self.failed.get() + count);
    }

    /// Sets the number of messages in work.
    pub fn set_queued(&self, count: usize) {
        self.queued.set(count as u64);
    }

    /// Records the latency of one unit of the stage's work.
    pub fn add_latency_ns(&self, latency_ns: i64) {
        let mut latencies = self.latencies_ns.borrow_mut();
        if latencies.len() < MAX_LATENCIES {
            latencies.push(latency_ns);
        }
    }

    /// Sets the device or component that the stage works with, in words.
    pub fn set_detail(&self, detail: impl Into<String>) {
        *self.detail.borrow_mut() = detail.into();
    }

    /// Counts a message to a receiver outside the pipeline as published or failed. `failures`
    /// limits the warning `what`.
    pub fn note_sent<E: std::fmt::Display>(
        &self,
        sent: Result<(), E>,
        failures: &mut Throttle,
        what: &str,
    ) {
        let Err(error) = sent else { return self.add_published(1) };
        self.add_failed(1);
        if let Some(more_since) = failures.admit() {
            tracing::warn!(more_since, "{what}: {error}");
        }
    }

    /// Overrides the state that the loop reports, for example `degraded` while a camera is missing.
    pub fn set_state(&self, state: Option<StageState>) {
        self.state.set(state);
    }

    /// Notes whether a linked component, such as a router, is present at `now_ns`. After five
    /// seconds of absence the loop reports `degraded`.
    pub fn note_link(&self, is_there: bool, now_ns: i64) {
        let since_ns = (!is_there).then(|| self.missing_since_ns.get().unwrap_or(now_ns));
        self.missing_since_ns.set(since_ns);
        let is_long = since_ns.is_some_and(|since_ns| now_ns - since_ns > MISSING_NS);
        self.set_state(is_long.then_some(StageState::Degraded));
    }

    /// The report. The collection of latencies starts anew.
    pub(crate) fn report(&self, identity: &Identity, state: StageState) -> Health {
        let latencies = std::mem::take(&mut *self.latencies_ns.borrow_mut());
        let mut latencies: Vec<f64> = latencies.into_iter().map(|ns| ns as f64).collect();
        latencies.sort_unstable_by(f64::total_cmp);
        // The contract uses -1 where nothing was done.
        let latency_ns = |found: Option<f64>| found.map_or(-1, |ns| ns.round() as i64);
        Health {
            sent_ns: clock::monotonic_ns(),
            taken: self.taken.get(),
            published: self.published.get(),
            dropped: self.dropped.get(),
            failed: self.failed.get(),
            queued: self.queued.get(),
            processor_ns: clock::processor_ns().unsigned_abs(),
            resident_bytes: resident_bytes().unwrap_or(0),
            latency_median_ns: latency_ns(median(&latencies)),
            latency_p99_ns: latency_ns(quantile(&latencies, 0.99)),
            stage: identity.stage.as_str().into(),
            detail: Text::from(self.detail.borrow().as_str()),
            replica: identity.replica,
            generation: identity.generation,
            pid: std::process::id(),
            state: self.state.get().unwrap_or(state).code(),
        }
    }
}

/// Identity of a process in the pipeline.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Identity {
    /// The stage's name in pipeline.yaml.
    pub stage: String,
    /// Number of the worker, from 0.
    pub replica: u32,
    /// Rises each time the process is replaced.
    pub generation: u32,
}

/// Period of the health reports.
pub(crate) const HEALTH_PERIOD: Duration = Duration::from_millis(250);

/// Resident memory of this process, from /proc.
fn resident_bytes() -> Option<u64> {
    let statm = std::fs::read_to_string("/proc/self/statm").ok()?;
    let pages: u64 = statm.split_whitespace().nth(1)?.parse().ok()?;
    Some(pages * rustix::param::page_size() as u64)
}

/// Counters that several parts of one stage share.
pub type SharedCounters = Rc<Counters>;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_link_that_is_missing_for_five_seconds_degrades_its_stage() {
        let counters = Counters::default();
        let state = |is_there, now_ns| {
            counters.note_link(is_there, now_ns);
            counters.state.get()
        };
        assert_eq!(state(false, 7), None);
        assert_eq!(state(false, 7 + MISSING_NS), None);
        assert_eq!(state(false, 8 + MISSING_NS), Some(StageState::Degraded));
        assert_eq!(state(true, 9 + MISSING_NS), None);
        assert_eq!(state(false, 10 + MISSING_NS), None, "it counts anew");
    }

    #[test]
    fn what_is_sent_is_counted_and_what_fails_too() {
        let (counters, mut failures) = (Counters::default(), Throttle::default());
        counters.note_sent(Ok::<(), &str>(()), &mut failures, "a message is not sent");
        counters.note_sent(Err("no link"), &mut failures, "a message is not sent");
        assert_eq!((counters.published.get(), counters.failed.get()), (1, 1));
    }

    #[test]
    fn a_report_says_what_was_counted() {
        let counters = Counters::default();
        counters.add_taken(3);
        counters.add_failed(1);
        counters.set_queued(7);
        counters.set_queued(4);
        counters.add_latency_ns(5);
        counters.add_latency_ns(9);
        counters.set_detail("a detail");
        let identity = Identity { stage: "detection".into(), replica: 2, generation: 1 };
        let health = counters.report(&identity, StageState::Ready);
        assert_eq!((health.taken, health.failed, health.latency_median_ns), (3, 1, 7));
        assert_eq!(health.latency_p99_ns, 9);
        assert_eq!(health.queued, 4);
        assert_eq!((health.stage.to_string(), health.replica), ("detection".into(), 2));
        assert!(health.resident_bytes > 0);
        assert_eq!(counters.report(&identity, StageState::Ready).latency_median_ns, -1);
    }
}
