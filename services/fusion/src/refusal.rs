//! Messages that pass the contract's check and yet cannot be true: they name a worker that does not
//! exist, a view that nobody planned, or a frame that nobody has begun.

use std::fmt;

use flockeye_contract::{DetectionHeader, FrameEnd, FrameStamp, ViewHeader};

/// Shortest interval of any source, nanoseconds.
const SHORTEST_INTERVAL_NS: u64 = 1_000_000;
/// Frames that may come at once, such as those that waited while this process was stopped.
const FREE_STEP: u64 = 64;

/// Why a message is refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refusal {
    /// There is no such worker.
    UnknownWorker {
        /// The worker that it names.
        worker: u32,
        /// How many there are.
        workers: u32,
    },
    /// The plan that it follows has no such view.
    UnplannedView {
        /// The view.
        view_index: u32,
        /// The plan.
        plan_id: u64,
    },
    /// Rectification has not begun this frame.
    UnknownFrame {
        /// Its sequence number.
        sequence: u64,
    },
    /// More views than the plan has.
    TooManyViews {
        /// How many are said to be issued.
        views: u32,
        /// The plan.
        plan_id: u64,
    },
    /// The sequence rose by more frames than any source makes in the time.
    ImpossibleStep {
        /// The frame's sequence number.
        sequence: u64,
        /// Sequence of the newest frame before.
        newest: u64,
    },
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::UnknownWorker { worker, workers } => {
                write!(f, "a record of worker {worker}; there are {workers}, counted from 0")
            }
            Self::UnplannedView { view_index, plan_id } => {
                write!(f, "a record of view {view_index}, which plan {plan_id} does not have")
            }
            Self::UnknownFrame { sequence } => {
                write!(f, "a record of frame {sequence}, of which no view has been cut")
            }
            Self::TooManyViews { views, plan_id } => {
                write!(f, "the end of a frame with {views} views, more than plan {plan_id} has")
            }
            Self::ImpossibleStep { sequence, newest } => {
                write!(f, "frame {sequence} too soon after frame {newest}")
            }
        }
    }
}

/// Knows what can be true in flight. A source that has begun anew may count from anywhere.
#[derive(Debug)]
pub struct Guard {
    workers: u32,
    /// The newest frame of which rectification has sent anything.
    newest: Option<FrameStamp>,
    /// When that came, nanoseconds of CLOCK_MONOTONIC. Exposures would not do: a camera's clock may
    /// jump.
    newest_ns: i64,
}

impl Guard {
    /// A guard of a pipeline with `workers` detection workers.
    pub fn new(workers: u32) -> Self {
        Self { workers, newest: None, newest_ns: 0 }
    }

    /// Why a view is refused.
    pub fn refuses_view(&mut self, view: &ViewHeader, now_ns: i64) -> Option<Refusal> {
        self.refuses_frame(&view.stamp, now_ns)
    }

    /// Why the end of a frame is refused. `planned` is how many views its plan has, where that is
    /// known.
    pub fn refuses_end(
        &mut self,
        end: &FrameEnd,
        planned: Option<usize>,
        now_ns: i64,
    ) -> Option<Refusal> {
        let (views, plan_id) = (end.views_issued, end.plan_id);
        if planned.is_some_and(|planned| views as usize > planned) {
            return Some(Refusal::TooManyViews { views, plan_id });
        }
        self.refuses_frame(&end.stamp, now_ns)
    }

    /// Why a frame is refused of which rectification sends something.
    fn refuses_frame(&mut self, stamp: &FrameStamp, now_ns: i64) -> Option<Refusal> {
        let refusal = self.impossible_step(stamp, now_ns);
        if refusal.is_none() && self.newest.is_none_or(|newest| newest.order() < stamp.order()) {
            (self.newest, self.newest_ns) = (Some(*stamp), now_ns);
        }
        refusal
    }

    /// Whether no source could have made so many frames since the newest one.
    fn impossible_step(&self, stamp: &FrameStamp, now_ns: i64) -> Option<Refusal> {
        let newest = self.newest.as_ref()?;
        let is_same_source =
            (newest.source_generation, newest.epoch) == (stamp.source_generation, stamp.epoch);
        let elapsed_ns = now_ns.saturating_sub(self.newest_ns).max(0);
        let most = FREE_STEP + elapsed_ns.unsigned_abs() / SHORTEST_INTERVAL_NS;
        let sequence = stamp.sequence;
        let is_impossible = is_same_source && sequence.saturating_sub(newest.sequence) > most;
        is_impossible.then_some(Refusal::ImpossibleStep { sequence, newest: newest.sequence })
    }

    /// Why a record is refused. `planned` is how many views its plan has, where that is known.
    /// Before rectification has sent anything, every frame may be one that was under way when this
    /// process began.
    pub fn refuses_record(
        &self,
        record: &DetectionHeader,
        planned: Option<usize>,
    ) -> Option<Refusal> {
        let DetectionHeader { worker, view_index, plan_id, stamp, .. } = *record;
        if worker >= self.workers {
            Some(Refusal::UnknownWorker { worker, workers: self.workers })
        } else if planned.is_some_and(|planned| view_index as usize >= planned) {
            Some(Refusal::UnplannedView { view_index, plan_id })
        } else if self.newest.is_some_and(|newest| stamp.order() > newest.order()) {
            Some(Refusal::UnknownFrame { sequence: stamp.sequence })
        } else {
            None
        }
    }
}
