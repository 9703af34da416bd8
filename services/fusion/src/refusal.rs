//! Impossible messages that pass the contract's check: with a worker that does not exist, an
//! unplanned view, or a frame that was not begun.

use flockeye_contract::{DetectionHeader, FrameEnd, FrameStamp};

/// Shortest interval of any source, nanoseconds.
const SHORTEST_INTERVAL_NS: u64 = 1_000_000;
/// Most frames that may arrive at once, such as those that waited while this process was stopped.
const FREE_STEP: u64 = 64;

/// Check for impossible messages in flight. A source that started anew may count from any number.
#[derive(Debug)]
pub(crate) struct Guard {
    workers: u32,
    /// The newest frame for which rectification has sent anything.
    newest: Option<FrameStamp>,
    /// Time of that message, nanoseconds of CLOCK_MONOTONIC. Exposures are not usable, because a
    /// camera's clock may jump.
    newest_ns: i64,
}

impl Guard {
    /// Creates the check of a pipeline with `workers` detection workers.
    pub(crate) fn new(workers: u32) -> Self {
        Self { workers, newest: None, newest_ns: 0 }
    }

    /// Reason why the end of a frame is refused. `planned` is the number of views in its plan, if
    /// known.
    pub(crate) fn refuses_end(
        &mut self,
        end: &FrameEnd,
        planned: Option<usize>,
        now_ns: i64,
    ) -> Option<String> {
        let (views, plan_id) = (end.views_issued, end.plan_id);
        if planned.is_some_and(|planned| views as usize > planned) {
            return Some(format!(
                "the end of a frame with {views} views, more than plan {plan_id} has"
            ));
        }
        self.refuses_frame(&end.stamp, now_ns)
    }

    /// Reason why a frame of a message from rectification is refused.
    pub(crate) fn refuses_frame(&mut self, stamp: &FrameStamp, now_ns: i64) -> Option<String> {
        let refusal = self.impossible_step(stamp, now_ns);
        if refusal.is_none() && self.newest.is_none_or(|newest| newest.order() < stamp.order()) {
            (self.newest, self.newest_ns) = (Some(*stamp), now_ns);
        }
        refusal
    }

    /// Whether no source could have made this many frames since the newest one.
    fn impossible_step(&self, stamp: &FrameStamp, now_ns: i64) -> Option<String> {
        let newest = self.newest.as_ref()?;
        let is_same_source =
            (newest.source_generation, newest.epoch) == (stamp.source_generation, stamp.epoch);
        let elapsed_ns = now_ns.saturating_sub(self.newest_ns).max(0);
        let most = FREE_STEP + elapsed_ns.unsigned_abs() / SHORTEST_INTERVAL_NS;
        let (sequence, newest) = (stamp.sequence, newest.sequence);
        let is_impossible = is_same_source && sequence.saturating_sub(newest) > most;
        is_impossible.then(|| format!("frame {sequence} too soon after frame {newest}"))
    }

    /// Reason why a record is refused. `planned` is the number of views in its plan, if known.
    /// Before the first message of rectification, every frame may have been under way when this
    /// process began.
    pub(crate) fn refuses_record(
        &self,
        record: &DetectionHeader,
        planned: Option<usize>,
    ) -> Option<String> {
        let DetectionHeader { worker, view_index, plan_id, stamp, .. } = *record;
        let workers = self.workers;
        if worker >= workers {
            Some(format!("a record of worker {worker}; there are {workers}, counted from 0"))
        } else if planned.is_some_and(|planned| view_index as usize >= planned) {
            Some(format!("a record of view {view_index}, which plan {plan_id} does not have"))
        } else if self.newest.is_some_and(|newest| stamp.order() > newest.order()) {
            Some(format!("a record of frame {}, of which no view has been cut", stamp.sequence))
        } else {
            None
        }
    }
}
