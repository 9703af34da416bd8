//! Searches of places that look like a body, for targets without a track, and for those whose track is not confirmed.

use flockeye_contract::FrameOrder;
use flockeye_imaging::align::{Attitudes, Place};
use nalgebra::{Isometry3, Unit};

use super::accounting::outcome_of;
use super::{FrameTime, Tracker, Update};
use crate::account::{Decision, Notes, Outcome, Pass, Trial};
use crate::hypothesis::{BestView, attitudes_near};
use crate::measurement::Measurement;
use crate::parallel;
use crate::passes::BestViews;
use crate::passes::background::{BackgroundQueue, PlaceSearch, Subject};
use crate::places::place_of;
use crate::policy::TimeBudget;
use crate::track_prior::TrackPrior;

/// A target, and where and in which attitudes it is looked for.
type Sought<'p> = (usize, BestView<'p>, Place, Attitudes);

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
        let is_asked = || self.is_place_due(time) || self.tentative(time).next().is_some();
        self.background.as_ref().is_some_and(BackgroundQueue::is_idle) && is_asked()
    }

    /// Whether the next place comes now, for a target without a track.
    fn is_place_due(&self, time: FrameTime) -> bool {
        let Some(interval_s) = self.place_interval_s else { return false };
        let since_s = self.last_place_s.map_or(f64::INFINITY, |last_s| time.at_s - last_s);
        // Where time goes back, another source has begun.
        (since_s >= interval_s || since_s < 0.0)
            && self.background.as_ref().is_some_and(|queue| queue.is_quiet(time.at_s))
            && self.targets.iter().any(|target| !target.is_tracked())
    }

    /// Has one place of a frame searched in the background. A target that was measured once and not in this frame comes
    /// first: its track would end soon. Else targets without a track take turns.
    pub fn request_place(
        &mut self,
        time: FrameTime,
        places: &[BestView<'_>],
        best_views: &BestViews<'_>,
    ) {
        let next = self.place_of_tentative(time, places, best_views);
        let is_new = next.is_none();
        let in_turn = || self.next_place(time, places).filter(|_| self.is_place_due(time));
        let Some((target, view, place, attitudes)) = next.or_else(in_turn) else { return };
        if is_new {
            self.place_turns.note(target, view.picture.view.direction_in_camera());
            self.last_place_s = Some(time.at_s);
        }
        let trial = self.place_trial(time, target, &view);
        let subject = Subject { order: time.order, at_s: time.at_s, target };
        let body = &self.targets[target].body;
        let asked = PlaceSearch { subject, body, view: &view, place, attitudes, trial };
        if let Some(queue) = &mut self.background {
            queue.request_place(asked);
        }
    }

    /// Targets with a track that is not confirmed, which a frame has not measured, with their predicted poses.
    fn tentative(&self, time: FrameTime) -> impl Iterator<Item = (usize, Isometry3<f64>)> {
        self.unpublished(time.order).filter_map(move |target| match self.prior(target, time.at_s) {
            TrackPrior::Tentative(predicted) => Some((target, predicted)),
            TrackPrior::Untracked | TrackPrior::Confirmed(_) => None,
        })
    }

    /// Where such a target is looked for: at the place next to its prediction, if one shows that too, else there itself.
    fn place_of_tentative<'p>(
        &self,
        time: FrameTime,
        places: &[BestView<'p>],
        best_views: &BestViews<'p>,
    ) -> Option<Sought<'p>> {
        self.tentative(time).find_map(|(target, predicted)| {
            let position = predicted.translation.vector;
            let direction = Unit::new_normalize(position);
            let off_rad =
                |place: &&BestView<'_>| place.picture.view.direction_in_camera().angle(&direction);
            let nearest = places
                .iter()
                .filter(|place| place.picture.view.holds(&direction, 0.0))
                .min_by(|a, b| off_rad(a).total_cmp(&off_rad(b)));
            let (view, direction) = match nearest {
                Some(place) => (*place, place.picture.view.direction_in_camera()),
                None => (*best_views.get(&target)?, direction),
            };
            let range_m = position.norm();
            let place = Place { direction_in_camera: direction.into_inner(), range_m };
            Some((target, view, place, attitudes_near(&predicted)))
        })
    }

    /// The place that comes next, and for whom.
    fn next_place<'p>(&self, time: FrameTime, places: &[BestView<'p>]) -> Option<Sought<'p>> {
        let free: Vec<&BestView<'_>> =
            places.iter().filter(|place| !self.is_taken(time, place)).collect();
        let directions: Vec<_> =
            free.iter().map(|place| place.picture.view.direction_in_camera()).collect();
        let untracked: Vec<usize> = self.untracked(time.order).collect();
        let (target, next) = self.place_turns.next(&untracked, &directions)?;
        let side_m = self.targets[target].body.largest_side();
        let place = place_of(&free[next].picture.view, side_m, self.radius_in_sides);
        Some((target, *free[next], place, self.aligner.attitudes(target)))
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
        let side_m = self.targets[target].body.largest_side();
        let at = place_of(&place.picture.view, side_m, self.radius_in_sides);
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
