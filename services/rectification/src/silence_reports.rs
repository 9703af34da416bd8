//! Reports of timeouts of the source and the workers.

use std::rc::Rc;
use std::time::Duration;

use flockeye_contract::StageName;
use flockeye_runtime::clock;
use flockeye_runtime::listening::Listening;
use flockeye_runtime::logs::Throttle;

use crate::core::Core;

/// Timeout of the source after which a warning is logged, nanoseconds.
const SILENCE_NS: i64 = 5_000_000_000;

pub(crate) struct SilenceReports {
    listening: Rc<Listening>,
    overdue: Duration,
    throttle: Throttle,
}

impl SilenceReports {
    /// Reports for workers with the timeout `overdue`.
    pub(crate) fn new(listening: Rc<Listening>, overdue: Duration) -> Self {
        Self { listening, overdue, throttle: Throttle::default() }
    }

    /// Reports current timeouts: of the source in the log, of a worker to the launcher, which
    /// replaces the worker's process.
    pub(crate) fn attend<F>(&mut self, core: &mut Core<F>) {
        let silence_ns = core.silence_ns(clock::monotonic_ns());
        if silence_ns > SILENCE_NS && self.throttle.admit().is_some() {
            let s = silence_ns / 1_000_000_000;
            tracing::warn!("no frame has come for {s} s: the source is away, or at its end");
        }
        for (worker, count) in core.silent_workers() {
            let detail = format!("no view answered for {} ms", self.overdue.as_millis());
            let worker = worker as u32;
            self.listening.complain_of_silence(StageName::Detection, worker, count, &detail);
        }
    }
}
