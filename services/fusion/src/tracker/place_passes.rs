//! Searches of places that look like a body, for targets without a track.

use flockeye_contract::FrameOrder;
use flockeye_imaging::align::{Attitudes, Place};

use super::accounting::outcome_of;
use super::{FrameTime, Tracker, Update};
use crate::account::{Decision, Notes, Outcome, Pass, Trial};
use crate::hypothesis::BestView;
use crate::measurement::Measurement;
use crate::parallel;
use crate::passes::background::Subject;
use crate::places::place_of;
use crate::policy::TimeBudget;

impl Tracker {
    /// The targets without a track that a frame has not measured.
    pub fn untracked(&self, order: FrameOrder) -> impl Iterator<Item = usize> {
        self.unpublished(order).filter(|&target| !self.targets[target].is_tracked())
    }

    /// The place pass: looks for a target at some `places` of a complete frame. The first place that shows it counts. Each
    /// takes some tenths of a second.
    pub fn place_pass(
        &mut self,
        time: FrameTime,
        target: usize,
        places: &[BestView<'_>],
    ) -> Option<Update> {
        let search = |place: &BestView<'_>| self.search(time, target, place);
        for (measurement, trial) in parallel::map(places, self.threads, search) {
            if let Some(trial) = trial {
                self.note(time.order, target, || Decision::Ran(trial));
            }
            let Some(measurement) = measurement else { continue };
            let update = self.take_in(time, target, &measurement);
            self.note_outcome(time.order, target, outcome_of(measurement, update.as_ref()));
            if update.is_some() {
                return update;
            }
        }
        None
    }

    /// Whether a place may be searched in the background now, in a frame that is over but for that.
    pub fn has_time_for_place(&self, time: FrameTime) -> bool {
        let Some(interval_s) = self.place_interval_s else { return false };
        let since_s = self.last_place_s.map_or(f64::INFINITY, |last_s| time.at_s - last_s);
        // Where time goes back, another source has begun.
        (since_s >= interval_s || since_s < 0.0)
            && self.background.as_ref().is_some_and(|queue| queue.is_quiet(time.at_s))
            && self.targets.iter().any(|target| !target.is_tracked())
    }

    /// Has one of a frame's places searched in the background for a target without a track. Both take turns.
    pub fn request_place(&mut self, time: FrameTime, places: &[BestView<'_>]) {
        let free: Vec<&BestView<'_>> =
            places.iter().filter(|place| !self.is_taken(time, place)).collect();
        let directions: Vec<_> =
            free.iter().map(|place| place.picture.view.direction_in_camera()).collect();
        let untracked: Vec<usize> = self.untracked(time.order).collect();
        let Some((target, next)) = self.place_turns.next(&untracked, &directions) else { return };
        self.place_turns.note(target, directions[next]);
        self.last_place_s = Some(time.at_s);
        let trial = self.place_trial(time, target, free[next]);
        let place = self.place_of(target, free[next]);
        let subject = Subject { order: time.order, at_s: time.at_s, target };
        if let Some(queue) = &mut self.background {
            let body = &self.targets[target].body;
            queue.search_place(subject, body, free[next], place, trial);
        }
    }

    /// The place that a view shows, for a target.
    fn place_of(&self, target: usize, view: &BestView<'_>) -> Place {
        let side_m = self.targets[target].body.largest_side();
        place_of(&view.picture.view, side_m, self.radius_in_sides)
    }

    /// Whether a tracked target is where a place is.
    fn is_taken(&self, time: FrameTime, place: &BestView<'_>) -> bool {
        self.predictions(time.at_s).any(|(target, prediction)| {
            let position = prediction.camera_from_markers.translation.vector;
            let radius_rad = (self.targets[target].body.radius() / position.norm()).min(1.0).asin();
            position.angle(&place.picture.view.direction_in_camera()) < radius_rad
        })
    }

    /// The account of a search, if somebody asks.
    fn place_trial(&self, time: FrameTime, target: usize, place: &BestView<'_>) -> Option<Trial> {
        self.is_noted(target).then(|| Trial {
            view_index: Some(place.view_index),
            outcome: Outcome::Nothing,
            ..Trial::of(Pass::Place, &self.prior(target, time.at_s), TimeBudget::OneFrame)
        })
    }

    /// Looks for a target at one place, in any attitude.
    fn search(
        &self,
        time: FrameTime,
        target: usize,
        place: &BestView<'_>,
    ) -> (Option<Measurement>, Option<Trial>) {
        let mut trial = self.place_trial(time, target, place);
        let at = self.place_of(target, place);
        let mut notes = Notes::into_list(trial.as_mut().map(|trial| &mut trial.hypotheses));
        let attitudes = Attitudes::Any;
        let found = self.aligner.find_at(target, &place.picture, &at, &attitudes, &mut notes);
        let measurement = found.map(|found| {
            let measurement = Measurement::aligned(&found, 0);
            self.corrected(measurement, place.rays_m, target, time.at_s)
        });
        (measurement, trial)
    }
}
