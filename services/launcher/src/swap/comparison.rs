//! Comparison of the answers of two processes of one stage.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

use flockeye_contract::FrameOrder;
use flockeye_geometry::statistics::median;
use nalgebra::Vector3;
use serde::Serialize;

/// Minimum share of the old process's frames in which the new process must answer anything. Two
/// processes on one machine both lose frames, and of a few frames one more or less is chance. The
/// number of answered views in a frame does not count: the flow adapts to the old process.
pub(crate) const LEAST_ANSWERED: f64 = 0.75;
/// Minimum share of the old process's findings that the new one must find in frames that both
/// answered.
pub(crate) const LEAST_FOUND: f64 = 0.75;
/// Number of standard deviations below which a difference is chance. Each process looks at its own
/// views, so their findings are independent Poisson numbers.
const CHANCE_DEVIATIONS: f64 = 2.0;
/// Number of compared frames of the old process. More are compared while it found less than
/// [`LEAST_FOUND_BY_OLD`], or while missed frames may be chance.
pub(crate) const FRAMES_COMPARED: usize = 10;
/// Minimum findings of the old process. With fewer, a new process that finds nothing could not be
/// distinguished from it.
pub(crate) const LEAST_FOUND_BY_OLD: usize = 8;
/// Number of newest frames whose answers may still arrive.
const FRAMES_UNSETTLED: usize = 2;
/// Maximum lag of the new process in frames, because both share the processors. A frame that it has
/// not reached does not count as unanswered. Its latency is compared apart.
const FRAMES_BEHIND: usize = 15;
/// Maximum number of kept frames.
const MAX_FRAMES: usize = 256;

/// An answer of one process.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct StageAnswer {
    pub frame: FrameOrder,
    /// The part of the frame: a view, or always 0.
    pub part: u64,
    /// Findings by number, with a position where it can be compared: markers' rays, targets'
    /// positions, the camera's rotation.
    pub found: Vec<(u32, Option<Vector3<f64>>)>,
    /// Latency of the answer, nanoseconds. `None`: another message counts as the answer.
    pub took_ns: Option<i64>,
}

/// The answers of one process to one frame.
#[derive(Debug, Clone, Default)]
struct FrameAnswers {
    parts: BTreeMap<u64, i64>,
    found: BTreeMap<(u64, u32), Option<Vector3<f64>>>,
}

type Answers = BTreeMap<FrameOrder, FrameAnswers>;

/// The newest answers of both.
#[derive(Debug, Clone, Default)]
pub(crate) struct SwapComparison {
    old: Answers,
    new: Answers,
}

/// Result of comparing some frames.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct SwapFigures {
    /// Frames that the old process answered.
    pub frames: usize,
    /// Frames among them in which the new process gave an answer that the old one also gave.
    pub frames_answered: usize,
    /// Answers of the old process to them.
    pub old_answers: usize,
    /// Answers among these that the new process also gave.
    pub new_answers: usize,
    /// Findings of the old process in the parts that both answered.
    pub old_found: usize,
    /// Findings of the new process there.
    pub new_found: usize,
    /// Median difference of the common findings: metres, or radians.
    pub difference: Option<f64>,
    /// Median latency of the old process, milliseconds.
    pub old_ms: f64,
    /// Median latency of the new process, milliseconds.
    pub new_ms: f64,
}

impl SwapComparison {
    /// Notes an answer of the process that is being replaced.
    pub(crate) fn note_old(&mut self, answer: StageAnswer) {
        note(&mut self.old, answer);
    }

    /// Notes an answer of the new process.
    pub(crate) fn note_new(&mut self, answer: StageAnswer) {
        note(&mut self.new, answer);
    }

    /// The newest frame that the old process has answered.
    pub(crate) fn newest(&self) -> Option<FrameOrder> {
        self.old.last_key_value().map(|(frame, _)| *frame)
    }

    /// Whether the new process has answered anything.
    pub(crate) fn has_begun(&self) -> bool {
        !self.new.is_empty()
    }

    /// Compares the last settled frames from `first` on, as few as show a difference. `None` while
    /// these are fewer than [`FRAMES_COMPARED`].
    pub(crate) fn figures(&self, first: Option<FrameOrder>) -> Option<SwapFigures> {
        let begun = *self.new.first_key_value()?.0;
        let first = first.map_or(begun, |first| first.max(begun));
        let frames: Vec<_> = self.old.range(first..).map(|(frame, _)| *frame).collect();
        let settled = &frames[..self.settled(&frames)];
        let mut begin = settled.len().checked_sub(FRAMES_COMPARED)?;
        loop {
            let figures = self.compare(&settled[begin..]);
            if (figures.is_conclusive() && !figures.misses_may_be_chance()) || begin == 0 {
                return Some(figures);
            }
            begin = begin.saturating_sub(FRAMES_COMPARED);
        }
    }

    /// Number of these frames of the old process that the new one has answered, or will never
    /// answer.
    fn settled(&self, frames: &[FrameOrder]) -> usize {
        let newest = self.new.last_key_value().map(|(frame, _)| *frame);
        let reached = frames.partition_point(|frame| Some(*frame) <= newest);
        let given_up = frames.len().saturating_sub(FRAMES_BEHIND);
        reached.max(given_up).min(frames.len().saturating_sub(FRAMES_UNSETTLED))
    }

    fn compare(&self, frames: &[FrameOrder]) -> SwapFigures {
        let none = FrameAnswers::default();
        let mut figures = SwapFigures {
            frames: frames.len(),
            frames_answered: 0,
            old_answers: 0,
            new_answers: 0,
            old_found: 0,
            new_found: 0,
            difference: None,
            old_ms: 0.0,
            new_ms: 0.0,
        };
        let (mut differences, mut old_ms, mut new_ms) = (Vec::new(), Vec::new(), Vec::new());
        for frame in frames {
            let old = self.old.get(frame).unwrap_or(&none);
            let new = self.new.get(frame).unwrap_or(&none);
            let both: BTreeSet<u64> =
                old.parts.keys().filter(|part| new.parts.contains_key(part)).copied().collect();
            figures.old_answers += old.parts.len();
            figures.new_answers += both.len();
            figures.frames_answered += usize::from(!both.is_empty());
            let found_in = |answers: &FrameAnswers| {
                answers.found.keys().filter(|(part, _)| both.contains(part)).count()
            };
            figures.old_found += found_in(old);
            figures.new_found += found_in(new);
            for (key, at) in &old.found {
                let other = new.found.get(key).copied().flatten();
                differences.extend(at.zip(other).map(|(at, other)| (at - other).norm()));
            }
            let ms = |took_ns: &i64| *took_ns as f64 * 1e-6;
            old_ms.extend(old.parts.values().map(ms));
            new_ms.extend(new.parts.values().map(ms));
        }
        for values in [&mut differences, &mut old_ms, &mut new_ms] {
            values.sort_by(f64::total_cmp);
        }
        figures.difference = median(&differences);
        figures.old_ms = median(&old_ms).unwrap_or(0.0);
        figures.new_ms = median(&new_ms).unwrap_or(0.0);
        figures
    }
}

fn note(answers: &mut Answers, answer: StageAnswer) {
    let StageAnswer { frame, part, found, took_ns } = answer;
    let frame = answers.entry(frame).or_default();
    if let Some(took_ns) = took_ns {
        frame.parts.insert(part, took_ns);
    }
    frame.found.extend(found.into_iter().map(|(number, at)| ((part, number), at)));
    while answers.len() > MAX_FRAMES {
        answers.pop_first();
    }
}

impl SwapFigures {
    /// Whether a new process that finds nothing would be noticed.
    pub(crate) fn is_conclusive(&self) -> bool {
        self.old_found >= LEAST_FOUND_BY_OLD
    }

    /// Whether too few frames were answered, but possibly by chance. The number of missed frames is
    /// binomial.
    pub(crate) fn misses_may_be_chance(&self) -> bool {
        let frames = self.frames as f64;
        let missing = LEAST_ANSWERED * frames - self.frames_answered as f64;
        let deviation = (frames * LEAST_ANSWERED * (1.0 - LEAST_ANSWERED)).sqrt();
        missing > 0.0 && missing <= CHANCE_DEVIATIONS * deviation
    }

    /// Reason why the new process is worse than the old one; `None` if it is not.
    pub(crate) fn shortcoming(&self) -> Option<String> {
        let share = |new: usize, old: usize| match old {
            0 => 1.0,
            old => new as f64 / old as f64,
        };
        if share(self.frames_answered, self.frames) < LEAST_ANSWERED {
            return Some(format!(
                "it answered in {} of the {} frames in which the old one did, and {:.0} % are wanted",
                self.frames_answered,
                self.frames,
                LEAST_ANSWERED * 100.0
            ));
        }
        let missing = self.old_found as f64 - self.new_found as f64;
        let chance = CHANCE_DEVIATIONS * ((self.old_found + self.new_found) as f64).sqrt();
        (share(self.new_found, self.old_found) < LEAST_FOUND && missing > chance).then(|| {
            format!(
                "it found {} where the old one found {}, and {:.0} % are wanted",
                self.new_found,
                self.old_found,
                LEAST_FOUND * 100.0
            )
        })
    }
}

impl fmt::Display for SwapFigures {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "in {} of {} frames answered, {} of {} answers, {} found against {}",
            self.frames_answered,
            self.frames,
            self.new_answers,
            self.old_answers,
            self.new_found,
            self.old_found
        )?;
        if let Some(difference) = self.difference {
            write!(f, ", {:.2} mm or mrad apart", difference * 1e3)?;
        }
        write!(f, ", {:.1} ms against {:.1}", self.new_ms, self.old_ms)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn answer(sequence: u64, part: u64, numbers: &[u32], off: f64) -> StageAnswer {
        let found =
            numbers.iter().map(|&number| (number, Some(Vector3::new(off, 0.0, 0.0)))).collect();
        StageAnswer { frame: (0, 0, sequence), part, found, took_ns: Some(2_000_000) }
    }

    fn compared(new: impl Fn(u64, u64) -> Option<StageAnswer>) -> Option<SwapFigures> {
        let mut comparison = SwapComparison::default();
        for frame in 0..12 {
            for part in 0..2 {
                comparison.note_old(answer(frame, part, &[3, 4], 0.0));
                if let Some(answer) = new(frame, part) {
                    comparison.note_new(answer);
                }
            }
        }
        comparison.figures(None)
    }

    #[test]
    fn one_that_is_behind_is_waited_for_and_one_that_stays_away_is_not() {
        let told = |frames: u64, answered: u64| {
            let mut comparison = SwapComparison::default();
            (0..frames).for_each(|frame| comparison.note_old(answer(frame, 0, &[3], 0.0)));
            (0..answered).for_each(|frame| comparison.note_new(answer(frame, 0, &[3], 0.0)));
            comparison.figures(None)
        };
        assert_eq!(told(22, 9), None, "of the first 10 frames one is on its way");
        let figures = told(22, 10).unwrap();
        assert_eq!((figures.frames, figures.frames_answered), (10, 10));
        let figures = told(30, 5).unwrap();
        assert_eq!((figures.frames, figures.frames_answered), (15, 5), "it does not come any more");
    }

    #[test]
    fn one_that_does_as_well_is_accepted() {
        let figures = compared(|frame, part| Some(answer(frame, part, &[3, 4], 0.002))).unwrap();
        assert_eq!((figures.frames, figures.old_answers, figures.new_answers), (10, 20, 20));
        assert_eq!((figures.old_found, figures.new_found), (40, 40));
        assert!((figures.difference.unwrap() - 0.002).abs() < 1e-12);
        assert_eq!(figures.shortcoming(), None);
        let text = figures.to_string();
        assert!(
            text.contains(
                "10 of 10 frames answered, 20 of 20 answers, 40 found against 40, 2.00 mm"
            ),
            "{text}"
        );
    }

    #[test]
    fn one_that_answers_or_finds_less_is_not() {
        let half =
            compared(|frame, part| (frame % 2 == 0).then(|| answer(frame, part, &[3, 4], 0.0)));
        let half = half.unwrap();
        let why = half.shortcoming().unwrap();
        assert!(why.contains("it answered in 5 of the 10 frames"), "{why}");
        assert!(
            half.misses_may_be_chance(),
            "of 10 frames 5 may be missed by one that misses 2.5 in the mean"
        );
        assert!(!SwapFigures { frames_answered: 4, ..half.clone() }.misses_may_be_chance());
        assert!(
            !SwapFigures { frames_answered: 8, ..half }.misses_may_be_chance(),
            "it is no shortcoming"
        );
        // One that is slower answers fewer views of each frame, and the flow adapts.
        let slow = compared(|frame, part| (part == 0).then(|| answer(frame, 0, &[3, 4], 0.0)));
        assert_eq!(slow.unwrap().shortcoming(), None);
        let figures = compared(|frame, part| Some(answer(frame, part, &[3], 0.0)));
        let why = figures.unwrap().shortcoming().unwrap();
        assert!(why.contains("it found 20 where the old one found 40"), "{why}");
    }

    #[test]
    fn small_differences_are_chance() {
        let mut comparison = SwapComparison::default();
        for frame in 0..14 {
            comparison.note_old(answer(frame, 0, &[7], 0.0));
            let numbers: &[u32] = if frame % 2 == 0 { &[7] } else { &[] };
            comparison.note_new(answer(frame, 0, numbers, 0.0));
        }
        let figures = comparison.figures(None).unwrap();
        assert_eq!((figures.old_found, figures.new_found), (10, 5));
        assert_eq!(figures.shortcoming(), None);
        assert!(SwapFigures { new_found: 1, ..figures }.shortcoming().is_some());
    }

    #[test]
    fn frames_before_the_first_answer_and_the_last_two_do_not_count() {
        // It begins with the third frame: too few are left of twelve.
        assert_eq!(
            compared(|frame, part| (frame > 1).then(|| answer(frame, part, &[], 0.0))),
            None
        );
        assert_eq!(compared(|_, _| None), None);
        let late = compared(|frame, part| (frame < 10).then(|| answer(frame, part, &[3, 4], 0.0)));
        assert_eq!(late.unwrap().shortcoming(), None);
    }
}
