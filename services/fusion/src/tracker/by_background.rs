//! Background passes: their jobs, and their answers, whose frames may have ended meanwhile.

use flockeye_contract::FrameOrder;

use super::{FilterChoice, FrameTime, Tracker, Update};
use crate::decide::outcome::{AnswerCase, Outcome};
use crate::frame::parts::{Part, Parts};
use crate::measure::background::{Answer, BackgroundQueue, Job, Subject};

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
    /// meanwhile, the answer only corrects a track that it agrees with, or starts one.
    pub fn background_answer(
        &mut self,
        answer: Answer,
        parts: Option<&mut Parts>,
    ) -> Option<(FrameOrder, Update)> {
        let (order, target) = (answer.subject.order, answer.subject.target);
        let is_wanted = self.background.as_mut()?.finish();
        let part = parts.and_then(|parts| parts.get_mut(target));
        let (update, outcome) = match is_wanted {
            true => self.take_in_answer(&answer, part),
            false => (None, Outcome::Cancelled),
        };
        self.note_trial(order, target, *answer.trial, outcome);
        Some((order, update?))
    }

    /// Takes in what a background pass found, and says what became of it.
    fn take_in_answer(
        &mut self,
        answer: &Answer,
        part: Option<&mut Part>,
    ) -> (Option<Update>, Outcome) {
        let Answer { subject: Subject { order, at_s, target }, is_independent, rays_m, .. } =
            *answer;
        let case = AnswerCase {
            is_late: part.is_none(),
            is_independent,
            is_tracked: self.targets[target].is_tracked(),
            is_within_history: self.is_within_history(order, at_s),
        };
        if case.is_late && case.may_begin_track() {
            // The frames since then did not show it only because it was not looked for there.
            self.targets[target].forget();
        }
        let Some(measurement) = answer.trial.measurement() else {
            return (None, Outcome::Nothing);
        };
        let measurement = self.corrected(measurement, rays_m, target, at_s);
        if case.waits(&measurement) {
            part.into_iter().for_each(|part| part.imprecise = Some(measurement));
            return (None, Outcome::Imprecise(measurement));
        }
        let ego = &self.camera.ego;
        let is_inside_gate = || self.targets[target].is_inside_gate(at_s, &measurement, ego);
        if !case.is_accepted(is_inside_gate) {
            return (None, Outcome::OutsideGate(measurement));
        }
        // The number of the frame matters only to passes that are still to run.
        let time = FrameTime { order, at_s, number: 0 };
        let (update, outcome) = self.take_in(time, target, part, measurement);
        let outcome = case.outcome(outcome, update.is_some());
        (update, outcome)
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
