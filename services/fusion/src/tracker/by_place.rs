//! Searches of places that look like a body, for targets of which nothing else is known.

use super::{FrameTime, Tracker, Update};
use crate::account::Pass;
use crate::aligner::BestView;
use crate::decide::outcome::Outcome;
use crate::frame::parts::Parts;
use crate::frame::places::place_of;
use crate::measure::Row;
use crate::measure::inputs::Inputs;
use crate::parallel;

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
        let measure = |place: &BestView<'_>| {
            self.place_inputs(time, target, place).measure(&self.means.aligner)
        };
        let trials = parallel::map(places, self.means.threads, measure);
        for (place, trial) in places.iter().zip(trials) {
            let Some(measurement) = trial.measurement() else {
                self.note_trial(time.order, target, trial, Outcome::Nothing);
                continue;
            };
            let measurement = self.corrected(measurement, place.rays_m, target, time.at_s);
            let (update, outcome) = self.take_in(time, target, parts.get_mut(target), measurement);
            self.note_trial(time.order, target, trial, outcome);
            if update.is_some() {
                return update;
            }
        }
        None
    }

    /// What one place offers of a target.
    fn place_inputs<'f>(
        &'f self,
        time: FrameTime,
        target: usize,
        view: &BestView<'f>,
    ) -> Inputs<'f> {
        let body = &self.targets[target].body;
        let side_m = body.largest_side();
        let place = place_of(&view.picture.view, side_m, self.means.radius_in_sides);
        let prior = self.prior(target, time.at_s);
        let inputs = Inputs::of_view(Pass::Place, target, body, prior, *view);
        Inputs { place: Some(place), ..inputs }
    }
}
