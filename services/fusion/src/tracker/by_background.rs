//! Background passes: their jobs, and their answers, whose frames may have ended meanwhile.

use flockeye_contract::FrameOrder;

use super::{FilterChoice, FrameTime, Tracker, Update};
use crate::account::Outcome;
use crate::frame::parts::Parts;
use crate::measure::background::{Answer, BackgroundQueue, Job, Subject};
use crate::target::outcome_of;

impl Tracker {
    /// The background pass that is to be run now.
    pub fn take_job(&mut self) -> Option<Job> {
        self.background.as_mut()?.take_job()
    }

    /// The frame in which a background pass may still find something.
    pub fn awaited(&self) -> Option<FrameOrder> {
        self.background.as_ref().and_then(BackgroundQueue::awaited)
    }

    /// Whether a background pass over a frame is under way or waits, cancelled or not.
    pub fn has_background_of(&self, order: FrameOrder) -> bool {
        self.background.as_ref().is_some_and(|queue| queue.is_about(order))
    }

    /// Takes in the answer of a background pass. `parts` are those of its frame. If that has ended
    /// meanwhile, the answer only corrects a track that it agrees with, or starts one: a pose that
    /// was found by the prior of a track that is lost since then means nothing.
    pub fn background_answer(
        &mut self,
        mut answer: Answer,
        parts: Option<&mut Parts>,
    ) -> Option<(FrameOrder, Update)> {
        let Answer { subject: Subject { order, at_s, target }, .. } = answer;
        let trial = answer.trial.take();
        let answer = self.background.as_mut()?.finish(answer);
        self.note_answer(order, trial, answer.is_none());
        let answer = answer?;
        let mut part = parts.and_then(|parts| parts.get_mut(target));
        let is_late = part.is_none();
        let may_start = answer.is_independent
            && !self.targets[target].is_tracked()
            && self.is_within_history(order, at_s);
        if is_late && may_start {
            // The frames since then did not show it only because it was not looked for there.
            self.targets[target].forget();
        }
        let measurement = self.corrected(answer.measurement?, answer.rays_m, target, at_s);
        if let Some(part) = part.as_mut().filter(|_| !measurement.is_precise) {
            part.imprecise = Some(measurement);
            self.note_outcome(order, target, Outcome::Imprecise(measurement));
            return None;
        }
        let is_accepted = !is_late
            || may_start
            || self.targets[target].is_inside_gate(at_s, &measurement, &self.camera.ego);
        // The number of the frame matters only to passes that are still to run.
        let time = FrameTime { order, at_s, number: 0 };
        let update = is_accepted.then(|| self.take_in(time, target, part, &measurement));
        let outcome = match &update {
            None => Outcome::OutsideGate(measurement),
            Some(Some(_)) if is_late => Outcome::Late(measurement),
            Some(update) => outcome_of(measurement, update.as_ref()),
        };
        self.note_outcome(order, target, outcome);
        Some((order, update??))
    }

    /// Whether measurements of a frame that was exposed then still count. Those of another source
    /// do not: its clock may be another.
    fn is_within_history(&self, order: FrameOrder, at_s: f64) -> bool {
        match self.filter {
            FilterChoice::Tracks(policy) => self.ended.is_none_or(|(ended, ended_s)| {
                (ended.0, ended.1) == (order.0, order.1) && ended_s - at_s <= policy.history_s
            }),
            FilterChoice::None => false,
        }
    }
}
