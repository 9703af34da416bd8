//! Searches of places that look like a body, for targets of which nothing else is known.

use super::{FrameTime, Tracker, Update};
use crate::account::{Pass, Trial};
use crate::aligner::BestView;
use crate::decide::outcome::Outcome;
use crate::frame::parts::Parts;
use crate::frame::places::place_of;
use crate::measure::Row;
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
        let trials = parallel::map(places, self.means.threads, search);
        for (place, trial) in places.iter().zip(trials) {
            let Some(measurement) = trial.measurement() else {
                self.note_trial(time.order, target, trial, Outcome::Nothing);
                continue;
            };
            let measurement = self.corrected(measurement, place.rays_m, target, time.at_s);
            let part = parts.get_mut(target);
            let (update, outcome) = self.take_in(time, target, part, measurement);
            self.note_trial(time.order, target, trial, outcome);
            if update.is_some() {
                return update;
            }
        }
        None
    }

    /// Looks for a target at one place.
    fn search(&self, time: FrameTime, target: usize, place: &BestView<'_>) -> Trial {
        let side_m = self.targets[target].body.largest_side();
        let at = place_of(&place.picture.view, side_m, self.means.radius_in_sides);
        let mut hypotheses = Vec::new();
        let aligner = &self.means.aligner;
        let decision = aligner.find_at(target, &place.picture, &at, &mut hypotheses);
        Trial {
            view_index: Some(place.view_index),
            hypotheses,
            decision,
            ..Trial::of(Pass::Place, &self.prior(target, time.at_s), TimeBudget::OneFrame)
        }
    }
}
