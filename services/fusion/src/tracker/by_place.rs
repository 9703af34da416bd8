//! Searches of places that look like a body, for targets of which nothing else is known.

use super::{FrameTime, Tracker, Update};
use crate::account::{Decision, Notes, Outcome, Pass, Trial};
use crate::frame::parts::Parts;
use crate::frame::places::place_of;
use crate::hypothesis::BestView;
use crate::measure::Row;
use crate::measurement::Measurement;
use crate::parallel;
use crate::policy::TimeBudget;

impl Tracker {
    /// The targets without a track that a frame has not measured.
    pub fn untracked(&self, parts: &Parts) -> impl Iterator<Item = usize> {
        let prior = Row::of(Pass::Place).prior;
        parts.unpublished().filter(move |&target| prior.allows(&self.targets[target]))
    }

    /// The place pass: looks for a target at some `places` of a complete frame. The first place
    /// that shows it counts. Each takes some tenths of a second.
    pub fn place_pass(
        &mut self,
        time: FrameTime,
        parts: &mut Parts,
        target: usize,
        places: &[BestView<'_>],
    ) -> Option<Update> {
        let search = |place: &BestView<'_>| self.search(time, target, place);
        for (measurement, trial) in parallel::map(places, self.means.threads, search) {
            if let Some(trial) = trial {
                self.note(time.order, target, || Decision::Ran(trial));
            }
            let Some(measurement) = measurement else { continue };
            let update = self.conclude(time, target, parts.get_mut(target), &measurement);
            if update.is_some() {
                return update;
            }
        }
        None
    }

    /// Looks for a target at one place.
    fn search(
        &self,
        time: FrameTime,
        target: usize,
        place: &BestView<'_>,
    ) -> (Option<Measurement>, Option<Trial>) {
        let mut trial = self.is_noted(target).then(|| Trial {
            view_index: Some(place.view_index),
            outcome: Outcome::Nothing,
            ..Trial::of(Pass::Place, &self.prior(target, time.at_s), TimeBudget::OneFrame)
        });
        let side_m = self.targets[target].body.largest_side();
        let at = place_of(&place.picture.view, side_m, self.means.radius_in_sides);
        let mut notes = Notes::into_list(trial.as_mut().map(|trial| &mut trial.hypotheses));
        let found = self.means.aligner.find_at(target, &place.picture, &at, &mut notes);
        let measurement = found.map(|found| {
            let measurement = Measurement::aligned(&found, 0);
            self.corrected(measurement, place.rays_m, target, time.at_s)
        });
        (measurement, trial)
    }
}
