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

pub mod comparison;
pub mod shadow;

use std::time::{Duration, Instant};

use flockeye_config::Pipeline;
use flockeye_contract::{FrameOrder, FrameStamp, HandOver, HandOverState};
use flockeye_runtime::clock;
use serde_json::json;

use self::comparison::{Comparison, Figures};
use self::shadow::Shadow;
use crate::control::Worker;
use crate::control::server::ClientId;
use crate::process::Process;

/// A new process takes over so many frames after the newest one: its word is everywhere by then.
const FRAMES_AHEAD: u64 = 4;
/// If nothing is heard of the first frames after the hand-over for this long, the new process has failed.
const PROBATION_TIME: Duration = Duration::from_secs(3);
/// After a hand-over was taken back, the new process is ended when this has passed.
const TAKING_BACK_TIME: Duration = Duration::from_millis(500);

/// A swap under way.
pub struct Swap {
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
    old_generation: u32,
    phase: Phase,
    began: Instant,
    deadline: Instant,
    accept_worse: bool,
    figures_in_shadow: Option<Figures>,
}

/// How far a swap is.
#[derive(Debug, Clone, PartialEq)]
enum Phase {
    /// The new process answers, and nobody listens.
    Shadow,
    /// It counts from `first` on.
    Probation { first: FrameOrder, until: Instant },
    /// The old process counts again, because of `reason`.
    TakingBack { until: Instant, reason: String },
}

/// What is to be done about a swap.
#[derive(Debug, Clone, PartialEq)]
pub enum Verdict {
    /// Nothing yet.
    Wait,
    /// The new process takes over.
    TakeOver(HandOver, String),
    /// The new process failed after it took over: the old one counts again.
    TakeBack(HandOver, String),
    /// The new process stays, and the old one is ended.
    Done(String, serde_json::Value),
    /// The new process is ended, and the old one stays.
    Refused(String),
}

/// How the two processes are at the moment.
#[derive(Debug, Clone, Copy)]
pub struct Lives<'a> {
    /// How the new process has ended, if it has.
    pub new_ended: Option<&'a str>,
    /// Whether the old process runs.
    pub old_runs: bool,
}

impl Swap {
    /// A swap whose candidate was just started in the shadow of `old_generation`.
    pub fn new(
        client: ClientId,
        candidate: Process,
        old_generation: u32,
        shadow: Shadow,
        within: Duration,
        accept_worse: bool,
    ) -> Self {
        let now = Instant::now();
        Self {
            client,
            worker: candidate.worker,
            candidate,
            pipeline_before: None,
            shadow,
            old_generation,
            phase: Phase::Shadow,
            began: now,
            deadline: now + within,
            accept_worse,
            figures_in_shadow: None,
        }
    }

    /// Whether a process of this generation is the one that is replaced.
    pub fn is_of_generation(&self, generation: u32) -> bool {
        generation == self.old_generation
    }

    /// The word that says who counts, in this state from this frame on.
    fn word(&self, state: HandOverState, first: FrameOrder, generations: [u32; 2]) -> HandOver {
        let (source_generation, epoch, sequence) = first;
        HandOver {
            first: FrameStamp { source_generation, epoch, sequence, ..FrameStamp::default() },
            sent_ns: clock::monotonic_ns(),
            stage: self.worker.stage.name().into(),
            replica: self.worker.replica,
            old_generation: generations[0],
            new_generation: generations[1],
            state: state.code(),
        }
    }

    /// The word that the new process does not count.
    pub fn begin(&self) -> HandOver {
        let generations = [self.old_generation, self.candidate.generation];
        self.word(HandOverState::Shadow, FrameOrder::default(), generations)
    }

    /// What is to be done now.
    pub fn judge(&mut self, lives: Lives<'_>, now: Instant) -> Verdict {
        match self.phase.clone() {
            Phase::Shadow => self.judge_shadow(lives, now),
            Phase::Probation { first, until } => self.judge_probation(lives, first, until, now),
            Phase::TakingBack { until, reason } => match now >= until {
                true => Verdict::Refused(reason),
                false => Verdict::Wait,
            },
        }
    }

    fn judge_shadow(&mut self, lives: Lives<'_>, now: Instant) -> Verdict {
        if let Some(how) = lives.new_ended {
            return Verdict::Refused(format!("the new process {how}"));
        }
        if !lives.old_runs {
            return Verdict::Refused(
                "the old process ended meanwhile, and is restarted".to_owned(),
            );
        }
        let figures = self.shadow.comparison.figures(None);
        // Where no neighbour is near, there may be nothing to find; then it is not waited for all the time.
        let has_waited = now + (self.deadline - self.began) / 2 >= self.deadline;
        let shortcoming = match &figures {
            Some(_) if self.accept_worse => None,
            Some(figures) if !figures.tells() && !has_waited => return Verdict::Wait,
            Some(figures) => figures.shortcoming(),
            None => Some(nothing_to_compare(&self.shadow.comparison)),
        };
        match (shortcoming, self.shadow.comparison.newest()) {
            (None, Some((source_generation, epoch, sequence))) => {
                let first = (source_generation, epoch, sequence + FRAMES_AHEAD);
                self.phase = Phase::Probation { first, until: now + PROBATION_TIME };
                let generations = [self.old_generation, self.candidate.generation];
                let word = self.word(HandOverState::TakenOver, first, generations);
                let shown = figures.as_ref().map_or_else(String::new, Figures::to_string);
                self.figures_in_shadow = figures;
                Verdict::TakeOver(word, format!("it takes over at frame {}: {shown}", first.2))
            }
            (Some(reason), _) if now >= self.deadline => Verdict::Refused(format!(
                "in {:.1} s the new process has not done as well as the old one: {reason}",
                (self.deadline - self.began).as_secs_f64()
            )),
            _ => Verdict::Wait,
        }
    }

    fn judge_probation(
        &mut self,
        lives: Lives<'_>,
        first: FrameOrder,
        until: Instant,
        now: Instant,
    ) -> Verdict {
        if let Some(how) = lives.new_ended {
            return self.take_back(format!("the new process {how} after it had taken over"), now);
        }
        let figures = self.shadow.comparison.figures(Some(first));
        if !lives.old_runs {
            return self.done(figures);
        }
        match figures {
            Some(figures) => match figures.shortcoming().filter(|_| !self.accept_worse) {
                Some(reason) => {
                    self.take_back(format!("after the new process had taken over, {reason}"), now)
                }
                None => self.done(Some(figures)),
            },
            None if now >= until => self.take_back(
                "after the new process had taken over, it answered too little".to_owned(),
                now,
            ),
            None => Verdict::Wait,
        }
    }

    fn done(&self, figures: Option<Figures>) -> Verdict {
        let took_s = self.began.elapsed().as_secs_f64();
        let shown = figures.as_ref().map_or_else(String::new, |figures| format!(": {figures}"));
        let report = json!({
            "worker": self.worker,
            "generation": self.candidate.generation,
            "took_s": took_s,
            "shadow": self.figures_in_shadow,
            "probation": figures,
        });
        Verdict::Done(format!("{} is swapped after {took_s:.1} s{shown}", self.worker), report)
    }

    fn take_back(&mut self, reason: String, now: Instant) -> Verdict {
        let newest = self.shadow.comparison.newest().unwrap_or_default();
        let first = (newest.0, newest.1, newest.2 + 1);
        self.phase = Phase::TakingBack { until: now + TAKING_BACK_TIME, reason: reason.clone() };
        let generations = [self.candidate.generation, self.old_generation];
        Verdict::TakeBack(self.word(HandOverState::TakenOver, first, generations), reason)
    }
}

/// Why the two cannot be compared.
fn nothing_to_compare(comparison: &Comparison) -> String {
    if comparison.has_begun() {
        "too few frames to compare".to_owned()
    } else {
        "it has answered nothing".to_owned()
    }
}
