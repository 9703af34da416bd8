//! Replacing the process of a stage in flight, so that no frame is lost.
//!
//! A stage that owns no device runs twice for a while. The new process starts in the *shadow* of the old
//! one: it gets all messages, and nobody listens to it but the launcher, which compares its answers with
//! the old one's. When it does as well, it *takes over* at a frame that everybody knows before it is
//! exposed. The old process stays beside it for the first frames of this *probation*, so that the hand-over
//! can be taken back. Messages tell whose they are by their generation
//! ([`HandOver`](flockeye_contract::HandOver)).
//!
//! | module | what it does |
//! | --- | --- |
//! | [`shadow`] | reads what both processes say |
//! | [`comparison`] | compares it, and says what is worse |
//! | [`judge`] | decides when the new one takes over, stays or goes |

pub(crate) mod comparison;
pub(crate) mod judge;
pub(crate) mod shadow;

use std::time::{Duration, Instant};

use flockeye_config::Pipeline;

use self::judge::{Judge, Lives, Verdict};
use self::shadow::Shadow;
use crate::control::Worker;
use crate::control::server::ClientId;
use crate::process::Process;

/// A swap under way.
pub(crate) struct Swap {
    /// Who asked for it.
    pub client: ClientId,
    /// Which worker.
    pub worker: Worker,
    /// The new process.
    pub candidate: Process,
    /// The configuration of before, if it was changed.
    pub pipeline_before: Option<Pipeline>,
    /// What both processes say.
    pub shadow: Shadow,
    /// Decides what is to be done.
    pub judge: Judge,
}

impl Swap {
    /// A swap whose candidate is about to start in the shadow of `old_generation`.
    pub(crate) fn new(
        client: ClientId,
        candidate: Process,
        old_generation: u32,
        shadow: Shadow,
        within: Duration,
        accept_worse: bool,
    ) -> Self {
        let generations = [old_generation, candidate.generation];
        let now = Instant::now();
        let judge = Judge::new(candidate.worker, generations, now, within, accept_worse);
        Self { client, worker: candidate.worker, candidate, pipeline_before: None, shadow, judge }
    }

    /// What is to be done now.
    pub(crate) fn judge(&mut self, lives: Lives<'_>, now: Instant) -> Verdict {
        self.judge.judge(&self.shadow.comparison, lives, now)
    }
}
