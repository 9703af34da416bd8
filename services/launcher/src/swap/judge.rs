//! Decides about a swap from the answers of both processes, whether both run, and the time alone.

use std::time::{Duration, Instant};

use flockeye_contract::{FrameOrder, FrameStamp, HandOver, HandOverState};
use flockeye_runtime::clock;
use serde_json::json;

use super::comparison::{Comparison, Figures};
use super::verdict::Verdict;
use crate::control::Worker;

/// A new process takes over this many frames after the newest one: all processes know it by then.
const FRAMES_AHEAD: u64 = 4;
/// If no answer to the first frames after the hand-over comes for this long, the new process has
/// failed. It has failed too if it still misses more frames than it may by then.
const PROBATION_TIME: Duration = Duration::from_secs(3);
/// After a hand-over was taken back, the new process is ended when this has passed.
const TAKING_BACK_TIME: Duration = Duration::from_millis(500);

/// Decides about one swap.
#[derive(Debug, Clone)]
pub(crate) struct Judge {
    worker: Worker,
    old_generation: u32,
    new_generation: u32,
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

/// How the two processes are at the moment.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Lives<'a> {
    /// How the new process has ended, if it has.
    pub new_ended: Option<&'a str>,
    /// Whether the old process runs.
    pub old_runs: bool,
}

impl Judge {
    /// Judges a swap of `worker` that begins at `now`, from the first generation to the second. The
    /// new process has `within` to do as well as the old one, or to answer at all if it may do
    /// worse.
    pub(crate) fn new(
        worker: Worker,
        [old_generation, new_generation]: [u32; 2],
        now: Instant,
        within: Duration,
        accept_worse: bool,
    ) -> Self {
        Self {
            worker,
            old_generation,
            new_generation,
            phase: Phase::Shadow,
            began: now,
            deadline: now + within,
            accept_worse,
            figures_in_shadow: None,
        }
    }

    /// Whether a process of this generation is the one that is replaced.
    pub(crate) fn is_of_generation(&self, generation: u32) -> bool {
        generation == self.old_generation
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

    /// What is to be done now, given the answers of both.
    pub(crate) fn judge(
        &mut self,
        comparison: &Comparison,
        lives: Lives<'_>,
        now: Instant,
    ) -> Verdict {
        match self.phase.clone() {
            Phase::Shadow => self.judge_shadow(comparison, lives, now),
            Phase::Probation { first, until } => {
                self.judge_probation(comparison, lives, first, until, now)
            }
            Phase::TakingBack { until, reason } => match now >= until {
                true => Verdict::Refused(reason),
                false => Verdict::Wait,
            },
        }
    }

    fn judge_shadow(&mut self, comparison: &Comparison, lives: Lives<'_>, now: Instant) -> Verdict {
        if let Some(how) = lives.new_ended {
            return Verdict::Refused(format!("the new process {how}"));
        }
        if !lives.old_runs {
            return Verdict::Refused(
                "the old process ended meanwhile, and is restarted".to_owned(),
            );
        }
        let figures = comparison.figures(None);
        // Where no neighbour is near, there may be nothing to find; then it is not waited for all
        // the time.
        let has_waited = now + (self.deadline - self.began) / 2 >= self.deadline;
        let shortcoming = match &figures {
            Some(figures) if !figures.is_conclusive() && !has_waited => return Verdict::Wait,
            Some(_) if self.accept_worse => None,
            Some(figures) => figures.shortcoming(),
            None => Some(nothing_to_compare(comparison)),
        };
        match (shortcoming, comparison.newest()) {
            (None, Some((source_generation, epoch, sequence))) => {
                let first = (source_generation, epoch, sequence + FRAMES_AHEAD);
                self.phase = Phase::Probation { first, until: now + PROBATION_TIME };
                let generations = [self.old_generation, self.new_generation];
                let hand_over = self.hand_over(HandOverState::TakenOver, first, generations);
                let shown = figures.as_ref().map_or_else(String::new, Figures::to_string);
                self.figures_in_shadow = figures;
                Verdict::TakeOver(hand_over, format!("it takes over at frame {}: {shown}", first.2))
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
        comparison: &Comparison,
        lives: Lives<'_>,
        first: FrameOrder,
        until: Instant,
        now: Instant,
    ) -> Verdict {
        if let Some(how) = lives.new_ended {
            return self.take_back(
                comparison,
                format!("the new process {how} after it had taken over"),
                now,
            );
        }
        let figures = comparison.figures(Some(first));
        if !lives.old_runs {
            return self.done(figures, now);
        }
        match figures {
            Some(figures) => match figures.shortcoming().filter(|_| !self.accept_worse) {
                Some(_) if figures.misses_may_be_chance() && now < until => Verdict::Wait,
                Some(reason) => self.take_back(
                    comparison,
                    format!("after the new process had taken over, {reason}"),
                    now,
                ),
                None => self.done(Some(figures), now),
            },
            None if now >= until => self.take_back(
                comparison,
                "after the new process had taken over, it answered too little".to_owned(),
                now,
            ),
            None => Verdict::Wait,
        }
    }

    fn done(&self, figures: Option<Figures>, now: Instant) -> Verdict {
        let took_s = (now - self.began).as_secs_f64();
        let shown = figures.as_ref().map_or_else(String::new, |figures| format!(": {figures}"));
        let report = json!({
            "worker": self.worker,
            "generation": self.new_generation,
            "took_s": took_s,
            "shadow": self.figures_in_shadow,
            "probation": figures,
        });
        Verdict::Done(format!("{} is swapped after {took_s:.1} s{shown}", self.worker), report)
    }

    fn take_back(&mut self, comparison: &Comparison, reason: String, now: Instant) -> Verdict {
        let newest = comparison.newest().unwrap_or_default();
        let first = (newest.0, newest.1, newest.2 + 1);
        self.phase = Phase::TakingBack { until: now + TAKING_BACK_TIME, reason: reason.clone() };
        let generations = [self.new_generation, self.old_generation];
        Verdict::TakeBack(self.hand_over(HandOverState::TakenOver, first, generations), reason)
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

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::swap::comparison::{Answer, Side};

    const WITHIN: Duration = Duration::from_secs(10);
    const ALIVE: Lives<'static> = Lives { new_ended: None, old_runs: true };

    /// A swap of fusion, and both processes' answers to these frames; the new one finds `found` of
    /// 2 things.
    #[derive(Clone)]
    struct Scene {
        judge: Judge,
        comparison: Comparison,
        start: Instant,
    }

    impl Scene {
        fn new() -> Self {
            Self::with(false)
        }

        fn with(accept_worse: bool) -> Self {
            let start = Instant::now();
            let judge = Judge::new("fusion".parse().unwrap(), [3, 4], start, WITHIN, accept_worse);
            Self { judge, comparison: Comparison::default(), start }
        }

        fn answers(&mut self, frames: std::ops::Range<u64>, found: u32) {
            for sequence in frames {
                self.answer(Side::Old, sequence, 2);
                self.answer(Side::New, sequence, found);
            }
        }

        fn answer(&mut self, side: Side, sequence: u64, count: u32) {
            let found = (0..count).map(|number| (number, None)).collect();
            let answer = Answer { frame: (0, 0, sequence), part: 0, found, took_ns: Some(1) };
            self.comparison.note(side, answer);
        }

        /// Both answer these frames but for the missed ones, which the old process alone answers.
        fn answers_but(&mut self, frames: std::ops::Range<u64>, is_missed: impl Fn(u64) -> bool) {
            for sequence in frames {
                self.answer(Side::Old, sequence, 2);
                if !is_missed(sequence) {
                    self.answer(Side::New, sequence, 2);
                }
            }
        }

        fn at(&mut self, seconds: f64, lives: Lives<'_>) -> Verdict {
            self.judge.judge(&self.comparison, lives, self.start + Duration::from_secs_f64(seconds))
        }

        /// In probation from frame 23 on.
        fn taken_over() -> Self {
            let mut scene = Self::new();
            scene.answers(0..20, 2);
            let Verdict::TakeOver(hand_over, _) = scene.at(1.0, ALIVE) else {
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

    fn reason(verdict: Verdict) -> String {
        match verdict {
            Verdict::Refused(reason) | Verdict::TakeBack(_, reason) => reason,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn who_does_as_well_takes_over_and_stays() {
        let mut scene = Scene::new();
        assert_eq!(scene.judge.begin().state, HandOverState::Shadow.code());
        assert_eq!(scene.at(0.1, ALIVE), Verdict::Wait);
        let mut scene = Scene::taken_over();
        assert_eq!(scene.at(1.1, ALIVE), Verdict::Wait);
        scene.answers(20..40, 2);
        let Verdict::Done(text, report) = scene.at(2.0, ALIVE) else { panic!("it does as well") };
        assert!(text.starts_with("fusion is swapped after 2.0 s"), "{text}");
        assert_eq!(report["generation"], 4);
    }

    #[test]
    fn who_finds_nothing_is_refused_at_the_deadline() {
        let mut scene = Scene::new();
        scene.answers(0..20, 0);
        assert_eq!(scene.at(9.9, ALIVE), Verdict::Wait);
        let reason = reason(scene.at(10.0, ALIVE));
        assert!(reason.contains("in 10.0 s the new process has not done as well"), "{reason}");
    }

    #[test]
    fn who_may_do_worse_takes_over_when_the_comparison_tells_something() {
        let mut scene = Scene::with(true);
        // Nobody is in sight yet.
        for sequence in 0..20 {
            for side in [Side::Old, Side::New] {
                let frame = (0, 0, sequence);
                let answer = Answer { frame, part: 0, found: Vec::new(), took_ns: Some(1) };
                scene.comparison.note(side, answer);
            }
        }
        assert_eq!(scene.at(1.0, ALIVE), Verdict::Wait);
        assert!(matches!(scene.clone().at(6.0, ALIVE), Verdict::TakeOver(..)), "nobody comes");
        scene.answers(20..40, 0);
        let Verdict::TakeOver(_, text) = scene.at(2.0, ALIVE) else { panic!("it may do worse") };
        assert!(text.contains("0 found against 20"), "{text}");
    }

    #[test]
    fn who_answers_nothing_is_refused_at_the_deadline() {
        let mut scene = Scene::new();
        assert_eq!(scene.at(5.0, ALIVE), Verdict::Wait);
        assert!(reason(scene.at(10.0, ALIVE)).contains("it has answered nothing"));
    }

    #[test]
    fn whoever_ends_in_the_shadow_ends_the_swap() {
        let mut scene = Scene::new();
        let ended = Lives { new_ended: Some("ended with status 1"), old_runs: true };
        assert_eq!(reason(scene.at(1.0, ended)), "the new process ended with status 1");
        let restarted = Lives { new_ended: None, old_runs: false };
        assert!(reason(scene.at(1.0, restarted)).contains("the old process ended meanwhile"));
    }

    #[test]
    fn who_fails_after_the_hand_over_is_taken_back_from_the_next_frame_on() {
        for (lives, found, wanted) in [
            (
                Lives { new_ended: Some("ended with status 1"), old_runs: true },
                2,
                "ended with status 1",
            ),
            (ALIVE, 0, "after the new process had taken over"),
        ] {
            let mut scene = Scene::taken_over();
            scene.answers(20..40, found);
            let Verdict::TakeBack(hand_over, reason) = scene.at(2.0, lives) else {
                panic!("it has failed")
            };
            assert!(reason.contains(wanted), "{reason}");
            assert_eq!((hand_over.old_generation, hand_over.new_generation), (4, 3));
            assert_eq!(hand_over.first.sequence, 40);
            // All processes know it before the new one ends.
            assert_eq!(scene.at(2.1, lives), Verdict::Wait);
            assert!(matches!(scene.at(3.0, lives), Verdict::Refused(_)));
        }
    }

    #[test]
    fn who_misses_some_frames_after_the_hand_over_is_looked_at_again() {
        let mut scene = Scene::taken_over();
        scene.answers_but(20..35, |sequence| (24..27).contains(&sequence));
        assert_eq!(scene.at(1.5, ALIVE), Verdict::Wait);
        let mut better = scene.clone();
        better.answers(35..40, 2);
        assert!(matches!(better.at(2.0, ALIVE), Verdict::Done(..)));
        // It does not get better, and all frames since the hand-over count.
        scene.answers_but(35..45, |sequence| sequence % 3 == 0);
        assert_eq!(scene.at(2.0, ALIVE), Verdict::Wait);
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
        let alone = Lives { new_ended: None, old_runs: false };
        assert!(matches!(scene.at(1.2, alone), Verdict::Done(..)));
    }
}
