//! Decisions about a swap, from the answers of both processes, their running states and the time
//! alone.

use std::time::{Duration, Instant};

use flockeye_contract::{FrameOrder, FrameStamp, HandOver, HandOverState};
use flockeye_runtime::clock;
use serde_json::json;

use super::comparison::{StageAnswer, SwapComparison, SwapFigures};
use super::verdict::SwapVerdict;
use crate::control::WorkerName;

/// Number of frames after the newest one at which a new process takes over: all processes have the
/// message by then.
const FRAMES_AHEAD: u64 = 4;
/// Duration of the probation. At its end the new process has failed if too few frames could be
/// compared, or if it still misses too many.
const PROBATION_TIME: Duration = Duration::from_secs(3);
/// Time after taking back a hand-over until the new process is ended.
const TAKING_BACK_TIME: Duration = Duration::from_millis(500);

/// State machine of one swap.
#[derive(Debug, Clone)]
pub(crate) struct Judge {
    pub worker: WorkerName,
    pub old_generation: u32,
    new_generation: u32,
    /// Answers of both processes.
    comparison: SwapComparison,
    phase: SwapPhase,
    began: Instant,
    deadline: Instant,
    accept_worse: bool,
    figures_in_shadow: Option<SwapFigures>,
}

/// Phase of a swap.
#[derive(Debug, Clone, PartialEq)]
enum SwapPhase {
    /// The new process answers, and no stage uses its answers.
    Shadow,
    /// The new process counts from `first` on.
    Probation { first: FrameOrder, until: Instant },
    /// The old process counts again, because of `reason`.
    TakingBack { until: Instant, reason: String },
}

impl Judge {
    /// Judges a swap of `worker` that begins at `now`, from the first generation to the second.
    /// The new process must do as well as the old one `within` this time. If `accept_worse`, it
    /// must only answer.
    pub(crate) fn new(
        worker: WorkerName,
        [old_generation, new_generation]: [u32; 2],
        now: Instant,
        within: Duration,
        accept_worse: bool,
    ) -> Self {
        Self {
            worker,
            old_generation,
            new_generation,
            comparison: SwapComparison::default(),
            phase: SwapPhase::Shadow,
            began: now,
            deadline: now + within,
            accept_worse,
            figures_in_shadow: None,
        }
    }

    /// Notes an answer of a process of this generation, if it is one of the two.
    pub(crate) fn note(&mut self, generation: u32, answer: StageAnswer) {
        if generation == self.old_generation {
            self.comparison.note_old(answer);
        } else if generation == self.new_generation {
            self.comparison.note_new(answer);
        }
    }

    /// The hand-over with this state from this frame on.
    fn hand_over(
        &self,
        state: HandOverState,
        first: FrameOrder,
        generations: [u32; 2],
    ) -> HandOver {
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

    /// The hand-over by which the new process does not count.
    pub(crate) fn begin(&self) -> HandOver {
        let generations = [self.old_generation, self.new_generation];
        self.hand_over(HandOverState::Shadow, FrameOrder::default(), generations)
    }

    /// The next step, given how the new process has ended, if it has, and whether the old one runs.
    pub(crate) fn judge(
        &mut self,
        new_ended: Option<&str>,
        old_runs: bool,
        now: Instant,
    ) -> SwapVerdict {
        match self.phase.clone() {
            SwapPhase::Shadow => self.judge_shadow(new_ended, old_runs, now),
            SwapPhase::Probation { first, until } => {
                self.judge_probation(new_ended, old_runs, first, until, now)
            }
            SwapPhase::TakingBack { until, reason } => match now >= until {
                true => SwapVerdict::Refused(reason),
                false => SwapVerdict::Wait,
            },
        }
    }

    fn judge_shadow(
        &mut self,
        new_ended: Option<&str>,
        old_runs: bool,
        now: Instant,
    ) -> SwapVerdict {
        if let Some(how) = new_ended {
            return SwapVerdict::Refused(format!("the new process {how}"));
        }
        if !old_runs {
            return SwapVerdict::Refused(
                "the old process ended meanwhile, and is restarted".to_owned(),
            );
        }
        let figures = self.comparison.figures(None);
        // Without a near neighbour there may be nothing to find. Then half of the time suffices.
        let has_waited = now + (self.deadline - self.began) / 2 >= self.deadline;
        let shortcoming = match &figures {
            Some(figures) if !figures.is_conclusive() && !has_waited => return SwapVerdict::Wait,
            Some(_) if self.accept_worse => None,
            Some(figures) => figures.shortcoming(),
            None => Some(nothing_to_compare(&self.comparison)),
        };
        match (shortcoming, self.comparison.newest()) {
            (None, Some((source_generation, epoch, sequence))) => {
                let first = (source_generation, epoch, sequence + FRAMES_AHEAD);
                self.phase = SwapPhase::Probation { first, until: now + PROBATION_TIME };
                let generations = [self.old_generation, self.new_generation];
                let hand_over = self.hand_over(HandOverState::TakenOver, first, generations);
                let shown = figures.as_ref().map_or_else(String::new, SwapFigures::to_string);
                self.figures_in_shadow = figures;
                SwapVerdict::TakeOver(
                    hand_over,
                    format!("it takes over at frame {}: {shown}", first.2),
                )
            }
            (Some(reason), _) if now >= self.deadline => SwapVerdict::Refused(format!(
                "in {:.1} s the new process has not done as well as the old one: {reason}",
                (self.deadline - self.began).as_secs_f64()
            )),
            _ => SwapVerdict::Wait,
        }
    }

    fn judge_probation(
        &mut self,
        new_ended: Option<&str>,
        old_runs: bool,
        first: FrameOrder,
        until: Instant,
        now: Instant,
    ) -> SwapVerdict {
        if let Some(how) = new_ended {
            return self.take_back(format!("the new process {how} after it had taken over"), now);
        }
        let figures = self.comparison.figures(Some(first));
        if !old_runs {
            return self.done(figures, now);
        }
        match figures {
            Some(figures) => match figures.shortcoming().filter(|_| !self.accept_worse) {
                Some(_) if figures.misses_may_be_chance() && now < until => SwapVerdict::Wait,
                Some(reason) => {
                    self.take_back(format!("after the new process had taken over, {reason}"), now)
                }
                None => self.done(Some(figures), now),
            },
            None if now >= until => self.take_back(
                "after the new process had taken over, it answered too little".to_owned(),
                now,
            ),
            None => SwapVerdict::Wait,
        }
    }

    fn done(&self, figures: Option<SwapFigures>, now: Instant) -> SwapVerdict {
        let took_s = (now - self.began).as_secs_f64();
        let shown = figures.as_ref().map_or_else(String::new, |figures| format!(": {figures}"));
        let report = json!({
            "worker": self.worker,
            "generation": self.new_generation,
            "took_s": took_s,
            "shadow": self.figures_in_shadow,
            "probation": figures,
        });
        SwapVerdict::Done(format!("{} is swapped after {took_s:.1} s{shown}", self.worker), report)
    }

    fn take_back(&mut self, reason: String, now: Instant) -> SwapVerdict {
        let newest = self.comparison.newest().unwrap_or_default();
        let first = (newest.0, newest.1, newest.2 + 1);
        self.phase =
            SwapPhase::TakingBack { until: now + TAKING_BACK_TIME, reason: reason.clone() };
        let generations = [self.new_generation, self.old_generation];
        SwapVerdict::TakeBack(self.hand_over(HandOverState::TakenOver, first, generations), reason)
    }
}

/// Reason why the two cannot be compared.
fn nothing_to_compare(comparison: &SwapComparison) -> String {
    if comparison.has_begun() {
        "too few frames to compare".to_owned()
    } else {
        "it has answered nothing".to_owned()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    const WITHIN: Duration = Duration::from_secs(10);
    /// Generations of the two processes.
    const OLD: u32 = 3;
    const NEW: u32 = 4;
    /// How the new process has ended, and whether the old one runs.
    type Lives = (Option<&'static str>, bool);
    const ALIVE: Lives = (None, true);

    /// A swap of fusion, and both processes' answers to these frames; the new one finds `found` of
    /// 2 things.
    #[derive(Clone)]
    struct Scene {
        judge: Judge,
        start: Instant,
    }

    impl Scene {
        fn new() -> Self {
            Self::with(false)
        }

        fn with(accept_worse: bool) -> Self {
            let start = Instant::now();
            let judge =
                Judge::new("fusion".parse().unwrap(), [OLD, NEW], start, WITHIN, accept_worse);
            Self { judge, start }
        }

        fn answers(&mut self, frames: std::ops::Range<u64>, found: u32) {
            for sequence in frames {
                self.answer(OLD, sequence, 2);
                self.answer(NEW, sequence, found);
            }
        }

        fn answer(&mut self, generation: u32, sequence: u64, count: u32) {
            let found = (0..count).map(|number| (number, None)).collect();
            let answer = StageAnswer { frame: (0, 0, sequence), part: 0, found, took_ns: Some(1) };
            self.judge.note(generation, answer);
        }

        /// Both answer these frames but for the missed ones, which the old process alone answers.
        fn answers_but(&mut self, frames: std::ops::Range<u64>, is_missed: impl Fn(u64) -> bool) {
            for sequence in frames {
                self.answer(OLD, sequence, 2);
                if !is_missed(sequence) {
                    self.answer(NEW, sequence, 2);
                }
            }
        }

        fn at(&mut self, seconds: f64, (new_ended, old_runs): Lives) -> SwapVerdict {
            let now = self.start + Duration::from_secs_f64(seconds);
            self.judge.judge(new_ended, old_runs, now)
        }

        /// In probation from frame 23 on.
        fn taken_over() -> Self {
            let mut scene = Self::new();
            scene.answers(0..20, 2);
            let SwapVerdict::TakeOver(hand_over, _) = scene.at(1.0, ALIVE) else {
                panic!("it does as well")
            };
            assert_eq!(
                (hand_over.first.sequence, hand_over.state),
                (23, HandOverState::TakenOver.code())
            );
            assert_eq!((hand_over.old_generation, hand_over.new_generation), (3, 4));
            scene
        }
    }

    fn reason(verdict: SwapVerdict) -> String {
        match verdict {
            SwapVerdict::Refused(reason) | SwapVerdict::TakeBack(_, reason) => reason,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn who_does_as_well_takes_over_and_stays() {
        let mut scene = Scene::new();
        assert_eq!(scene.judge.begin().state, HandOverState::Shadow.code());
        assert_eq!(scene.at(0.1, ALIVE), SwapVerdict::Wait);
        let mut scene = Scene::taken_over();
        assert_eq!(scene.at(1.1, ALIVE), SwapVerdict::Wait);
        scene.answers(20..40, 2);
        let SwapVerdict::Done(text, report) = scene.at(2.0, ALIVE) else {
            panic!("it does as well")
        };
        assert!(text.starts_with("fusion is swapped after 2.0 s"), "{text}");
        assert_eq!(report["generation"], 4);
    }

    #[test]
    fn who_finds_nothing_is_refused_at_the_deadline() {
        let mut scene = Scene::new();
        scene.answers(0..20, 0);
        assert_eq!(scene.at(9.9, ALIVE), SwapVerdict::Wait);
        let reason = reason(scene.at(10.0, ALIVE));
        assert!(reason.contains("in 10.0 s the new process has not done as well"), "{reason}");
    }

    #[test]
    fn who_may_do_worse_takes_over_when_the_comparison_tells_something() {
        let mut scene = Scene::with(true);
        // Nobody is in sight yet.
        for sequence in 0..20 {
            scene.answer(OLD, sequence, 0);
            scene.answer(NEW, sequence, 0);
        }
        assert_eq!(scene.at(1.0, ALIVE), SwapVerdict::Wait);
        assert!(matches!(scene.clone().at(6.0, ALIVE), SwapVerdict::TakeOver(..)), "nobody comes");
        scene.answers(20..40, 0);
        let SwapVerdict::TakeOver(_, text) = scene.at(2.0, ALIVE) else {
            panic!("it may do worse")
        };
        assert!(text.contains("0 found against 20"), "{text}");
    }

    #[test]
    fn who_answers_nothing_is_refused_at_the_deadline() {
        let mut scene = Scene::new();
        assert_eq!(scene.at(5.0, ALIVE), SwapVerdict::Wait);
        assert!(reason(scene.at(10.0, ALIVE)).contains("it has answered nothing"));
    }

    #[test]
    fn whoever_ends_in_the_shadow_ends_the_swap() {
        let mut scene = Scene::new();
        let ended = (Some("ended with status 1"), true);
        assert_eq!(reason(scene.at(1.0, ended)), "the new process ended with status 1");
        let restarted = (None, false);
        assert!(reason(scene.at(1.0, restarted)).contains("the old process ended meanwhile"));
    }

    #[test]
    fn who_fails_after_the_hand_over_is_taken_back_from_the_next_frame_on() {
        for (lives, found, wanted) in [
            ((Some("ended with status 1"), true), 2, "ended with status 1"),
            (ALIVE, 0, "after the new process had taken over"),
        ] {
            let mut scene = Scene::taken_over();
            scene.answers(20..40, found);
            let SwapVerdict::TakeBack(hand_over, reason) = scene.at(2.0, lives) else {
                panic!("it has failed")
            };
            assert!(reason.contains(wanted), "{reason}");
            assert_eq!((hand_over.old_generation, hand_over.new_generation), (4, 3));
            assert_eq!(hand_over.first.sequence, 40);
            // All processes know it before the new one ends.
            assert_eq!(scene.at(2.1, lives), SwapVerdict::Wait);
            assert!(matches!(scene.at(3.0, lives), SwapVerdict::Refused(_)));
        }
    }

    #[test]
    fn who_misses_some_frames_after_the_hand_over_is_looked_at_again() {
        let mut scene = Scene::taken_over();
        scene.answers_but(20..35, |sequence| (24..27).contains(&sequence));
        assert_eq!(scene.at(1.5, ALIVE), SwapVerdict::Wait);
        let mut better = scene.clone();
        better.answers(35..40, 2);
        assert!(matches!(better.at(2.0, ALIVE), SwapVerdict::Done(..)));
        // It does not get better, and all frames since the hand-over count.
        scene.answers_but(35..45, |sequence| sequence % 3 == 0);
        assert_eq!(scene.at(2.0, ALIVE), SwapVerdict::Wait);
        assert!(reason(scene.at(4.1, ALIVE)).contains("of the 20 frames"));
        // This many are not missed by chance.
        let mut scene = Scene::taken_over();
        scene.answers_but(20..35, |sequence| (24..31).contains(&sequence));
        assert!(reason(scene.at(1.5, ALIVE)).contains("it answered in 3 of the 10 frames"));
    }

    #[test]
    fn who_falls_silent_after_the_hand_over_is_taken_back() {
        let mut scene = Scene::taken_over();
        let reason = reason(scene.at(4.1, ALIVE));
        assert!(reason.contains("it answered too little"), "{reason}");
    }

    #[test]
    fn if_the_old_one_ends_in_the_probation_the_new_one_stays() {
        let mut scene = Scene::taken_over();
        let alone = (None, false);
        assert!(matches!(scene.at(1.2, alone), SwapVerdict::Done(..)));
    }
}
