//! Searches at places that look like a body, for targets that were not measured.

use super::{Tracker, Update};
use crate::account::{Pass, Trial};
use crate::aligner::BestView;
use crate::decide::outcome::Outcome;
use crate::frame::parts::{Part, unpublished};
use crate::frame::places::place_of;
use crate::measure::FrameTime;
use crate::measurement::PoseMeasurement;
use crate::parallel;
use crate::policy::TimeBudget;

impl Tracker {
    /// The targets without a track that a frame has not measured.
    pub(crate) fn untracked(&self, parts: &[Part]) -> impl Iterator<Item = usize> {
        unpublished(parts).filter(|&target| !self.targets[target].is_tracked())
    }

    /// The place pass: searches for a target at some `places` of a complete frame. The first place
    /// that shows it counts. Each takes some tenths of a second.
    pub(crate) fn place_pass(
        &mut self,
        time: FrameTime,
        parts: &mut [Part],
        target: usize,
        places: &[BestView<'_>],
    ) -> Option<Update> {
        let search = |view: &BestView<'_>| self.place_trial(time, target, view);
        let trials = parallel::map(places, self.threads, search);
        for (place, trial) in places.iter().zip(trials) {
            let measurement = trial.measurement();
            let Some(measurement) = measurement.filter(PoseMeasurement::is_usable_alone) else {
                self.note_trial(time.order, target, trial, Outcome::Nothing);
                continue;
            };
            let measurement = self.corrected(measurement, place.rays_m, target, time.at_s);
            let part = parts.get_mut(target);
            let update = self.take_in_trial(time, target, part, measurement, trial);
            if update.is_some() {
                return update;
            }
        }
        None
    }

    /// Searches one place for a target.
    fn place_trial(&self, time: FrameTime, target: usize, view: &BestView<'_>) -> Trial {
        let side_m = self.targets[target].body.largest_side();
        let place = place_of(&view.picture.view, side_m, self.radius_in_sides);
        let mut hypotheses = Vec::new();
        let decision = self.aligner.find_at(target, &view.picture, &place, &mut hypotheses);
        let prior = self.prior(target, time.at_s);
        let begun = Trial::of(Pass::Place, &prior, TimeBudget::OneFrame);
        Trial { view_index: Some(view.view_index), hypotheses, decision, ..begun }
    }
}
