//! Background passes: their jobs, and their answers, whose frames may have ended meanwhile.

use flockeye_contract::FrameOrder;
use flockeye_geometry::filter::HISTORY_S;

use super::{Tracker, Update};
use crate::account::Trial;
use crate::decide::outcome::Outcome;
use crate::frame::parts::Part;
use crate::measure::FrameTime;
use crate::measure::background::{BackgroundSlot, Job, UnderWay};
use crate::stitching::remade;

impl Tracker {
    /// Returns the background pass to run now.
    pub(crate) fn take_job(&mut self) -> Option<Job> {
        self.background.as_mut()?.take_job()
    }

    /// The frame in which a background pass may still have a result.
    pub(crate) fn awaited(&self) -> Option<FrameOrder> {
        self.background.as_ref().and_then(BackgroundSlot::awaited)
    }

    /// Whether a background pass over a frame runs, cancelled or not.
    pub fn has_background_of(&self, order: FrameOrder) -> bool {
        self.background.as_ref().is_some_and(|slot| slot.is_about(order))
    }

    /// The frame of the running background pass, cancelled or not.
    pub(crate) fn under_way(&self) -> Option<FrameOrder> {
        Some(self.background.as_ref()?.under_way.as_ref()?.time.order)
    }

    /// Handles the answer of the running background pass. `parts` are those of its frame. If that
    /// has ended meanwhile, the answer only corrects a track that it fits, or starts one.
    pub(crate) fn background_answer(
        &mut self,
        answer: Trial,
        parts: Option<&mut Vec<Part>>,
    ) -> Option<(FrameOrder, Update)> {
        let finished = self.background.as_mut()?.finish()?;
        let part = parts.and_then(|parts| parts.get_mut(finished.target));
        let (update, outcome) = match finished.is_cancelled {
            true => (None, Outcome::Cancelled),
            false => self.take_in_answer(&finished, &answer, part),
        };
        self.note_trial(finished.time.order, finished.target, answer, outcome);
        Some((finished.time.order, update?))
    }

    /// Handles the result of a background pass, and returns its outcome. After the end of its
    /// frame, the pose must fit the track, replace it or begin one, and nothing of it is published.
    fn take_in_answer(
        &mut self,
        &UnderWay { time, target, rays_m, stitch, .. }: &UnderWay,
        trial: &Trial,
        part: Option<&mut Part>,
    ) -> (Option<Update>, Outcome) {
        let is_late = part.is_none();
        // A pose from the prior of a track that is lost since then is meaningless.
        let may_begin_track = !trial.is_confirmed
            && trial.decision.hypothesis().is_some()
            && !self.targets[target].is_tracked()
            && self.is_within_history(time);
        if is_late && may_begin_track {
            // Later frames did not show it only because it was not searched for there.
            self.targets[target].forget();
        }
        let Some(measurement) = trial.measurement() else {
            return (None, Outcome::Nothing);
        };
        let mut measurement = self.corrected(measurement, rays_m, target, time.at_s);
        // More may be known of the lenses since that frame.
        if let Some((before, now)) = stitch.zip(self.camera.stitching.as_ref()) {
            let radius_m = self.targets[target].body.radius();
            measurement.pose = remade(&measurement.pose, radius_m, &before, now.current());
        }
        if !is_late && !measurement.is_usable_alone() {
            // A better pose may be found until the frame ends.
            part.into_iter().for_each(|part| part.imprecise = Some(measurement));
            return (None, Outcome::Imprecise(measurement));
        }
        let is_accepted =
            || self.targets[target].accepts(time.at_s, &measurement, &self.camera.ego);
        if is_late && !may_begin_track && !is_accepted() {
            return (None, Outcome::OutsideGate(measurement));
        }
        let (update, outcome) = self.take_in(time, target, part, measurement);
        let outcome = match is_late && update.is_some() {
            true => Outcome::Late(measurement),
            false => outcome,
        };
        (update, outcome)
    }

    /// Whether measurements of a frame with this exposure still count. Those of another source do
    /// not, because its clock may differ.
    fn is_within_history(&self, FrameTime { order, at_s, .. }: FrameTime) -> bool {
        self.filter.is_some()
            && self.ended.is_none_or(|(ended, ended_s)| {
                (ended.0, ended.1) == (order.0, order.1) && ended_s - at_s <= HISTORY_S
            })
    }
}
