//! Reports of a source or a worker that is silent.

use std::rc::Rc;
use std::time::Duration;

use flockeye_contract::StageName;
use flockeye_runtime::clock;
use flockeye_runtime::listening::Listening;
use flockeye_runtime::logs::Throttle;

use crate::core::Core;

/// Silence of a source that is reported, nanoseconds.
const SILENCE_NS: i64 = 5_000_000_000;

pub(crate) struct SilenceReports {
    listening: Rc<Listening>,
    overdue: Duration,
    throttle: Throttle,
}

impl SilenceReports {
    /// Reports workers that answer nothing for `overdue`.
    pub(crate) fn new(listening: Rc<Listening>, overdue: Duration) -> Self {
        Self { listening, overdue, throttle: Throttle::default() }
    }

    /// Reports what is silent now: a source in the log, a worker to the launcher, which knows the
    /// worker's process and replaces it.
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
