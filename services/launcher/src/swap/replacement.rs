//! Decisions about a swap in which the old process ends before the new one starts.

use std::time::{Duration, Instant};

use flockeye_contract::FrameOrder;
use serde_json::json;

use super::verdict::SwapVerdict;
use crate::control::WorkerName;

/// A new process that is started when the old one has ended.
#[derive(Debug, Clone)]
pub(crate) struct Replacement {
    worker: WorkerName,
    /// Program and arguments of the old process.
    pub old_command: Vec<String>,
    old_generation: u32,
    new_generation: u32,
    /// Time at which the end of the old process was requested.
    began: Instant,
    deadline: Instant,
    /// The newest frame before the swap.
    newest_before: Option<FrameOrder>,
}

/// State of a worker while its process is replaced.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct ReplacementProgress {
    /// The generation of the worker's process.
    pub generation: u32,
    /// Whether that process runs.
    pub runs: bool,
    /// Whether that process has reported that it is ready.
    pub is_ready: bool,
    /// The newest frame of the pipeline.
    pub newest_frame: Option<FrameOrder>,
}

impl Replacement {
    /// A swap of `worker` that begins at `now`, from the first generation to the second. The new
    /// process must work `within` this time.
    pub(crate) fn new(
        worker: WorkerName,
        [old_generation, new_generation]: [u32; 2],
        old_command: Vec<String>,
        newest_before: Option<FrameOrder>,
        now: Instant,
        within: Duration,
    ) -> Self {
        Self {
            worker,
            old_command,
            old_generation,
            new_generation,
            began: now,
            deadline: now + within,
            newest_before,
        }
    }

    /// The next step.
    pub(crate) fn judge(&self, progress: &ReplacementProgress, now: Instant) -> SwapVerdict {
        let is_new = progress.generation == self.new_generation;
        let has_failed = progress.generation > self.new_generation
            || (is_new && !progress.runs)
            || now >= self.deadline;
        let gap_s = (now - self.began).as_secs_f64();
        if is_new && progress.runs && self.works(progress) {
            let worker = self.worker;
            let report =
                json!({ "worker": worker, "generation": progress.generation, "gap_s": gap_s });
            let text = format!("{worker} is swapped; {gap_s:.2} s passed without it");
            return SwapVerdict::Done(text, report);
        }
        match has_failed {
            true => SwapVerdict::Refused(format!(
                "the new process did not work within {gap_s:.1} s. The old program is started again"
            )),
            false => SwapVerdict::Wait,
        }
    }

    /// Whether the new process works: a source publishes frames, others are ready.
    fn works(&self, progress: &ReplacementProgress) -> bool {
        if !self.worker.stage.is_source() {
            return progress.is_ready;
        }
        progress.newest_frame.is_some_and(|newest| {
            newest.0 > self.old_generation && Some(newest) > self.newest_before
        })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    /// A swap of this worker from generation 2 to 3, and what is to be done after so many seconds.
    fn judged(worker: &str, progress: ReplacementProgress, seconds: u64) -> SwapVerdict {
        let (start, within) = (Instant::now(), Duration::from_secs(10));
        let worker = worker.parse().unwrap();
        let frame = Some((2, 0, 100));
        let swap = Replacement::new(worker, [2, 3], Vec::new(), frame, start, within);
        swap.judge(&progress, start + Duration::from_secs(seconds))
    }

    const NEW: ReplacementProgress = ReplacementProgress {
        generation: 3,
        runs: true,
        is_ready: true,
        newest_frame: Some((2, 0, 100)),
    };

    #[test]
    fn who_is_ready_in_time_stays() {
        let SwapVerdict::Done(text, report) = judged("gateway", NEW, 2) else {
            panic!("it is ready")
        };
        assert_eq!(text, "gateway is swapped; 2.00 s passed without it");
        assert_eq!((&report["generation"], &report["gap_s"]), (&json!(3), &json!(2.0)));
        let slow = ReplacementProgress { is_ready: false, ..NEW };
        assert_eq!(judged("gateway", slow, 9), SwapVerdict::Wait);
        assert!(matches!(judged("gateway", slow, 10), SwapVerdict::Refused(_)));
    }

    #[test]
    fn a_source_must_give_frames() {
        assert_eq!(judged("capture", NEW, 2), SwapVerdict::Wait);
        let flies = ReplacementProgress { newest_frame: Some((3, 0, 0)), ..NEW };
        assert!(matches!(judged("capture", flies, 2), SwapVerdict::Done(..)));
    }

    #[test]
    fn who_ends_or_is_started_again_has_failed() {
        let old = ReplacementProgress { generation: 2, ..NEW };
        assert_eq!(judged("gateway", old, 2), SwapVerdict::Wait, "the old process has yet to end");
        for failed in [
            ReplacementProgress { runs: false, ..NEW },
            ReplacementProgress { generation: 4, ..NEW },
        ] {
            let SwapVerdict::Refused(reason) = judged("gateway", failed, 2) else {
                panic!("it has failed")
            };
            assert!(reason.contains("did not work within 2.0 s"), "{reason}");
        }
    }
}
