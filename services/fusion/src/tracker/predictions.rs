//! What tracks say of a time: where targets are, and how they move as the camera sees them.

use flockeye_geometry::ego_rotation::CameraTurn;
use flockeye_geometry::filter::Prediction;
use flockeye_imaging::align::Motion;

use super::{FilterChoice, Tracker};
use crate::track_prior::TrackPrior;

impl Tracker {
    /// The camera has turned. What was measured since then is filtered anew.
    pub fn turn_camera(&mut self, turn: &CameraTurn) {
        self.ego.add(turn);
        self.targets.iter_mut().for_each(|target| target.refilter(turn.earlier_s, &self.ego));
    }

    /// Where a tracked target is at a time.
    pub fn prediction(&self, target: usize, at_s: f64) -> Option<Prediction> {
        match self.filter {
            FilterChoice::Tracks(_) => self.targets.get(target)?.predict(at_s, &self.ego),
            FilterChoice::None => None,
        }
    }

    /// Where each tracked target will be at a time, by its number.
    pub fn predictions(&self, at_s: f64) -> impl Iterator<Item = (usize, Prediction)> {
        let targets = 0..self.targets.len();
        targets.filter_map(move |target| Some((target, self.prediction(target, at_s)?)))
    }

    /// How a target moves across the line of sight while a frame is exposed, as far as its track says: no
    /// more than a confirmed one's `prior`.
    pub(super) fn motion(&self, target: usize, at_s: f64, prior: &TrackPrior) -> Motion {
        let prediction = prior.confirmed().and_then(|_| self.prediction(target, at_s));
        let Some(prediction) = prediction else { return Motion::default() };
        let position = prediction.camera_from_markers.translation.vector;
        let (sight, velocity) = (position.normalize(), prediction.apparent_velocity());
        let across = velocity - sight * sight.dot(&velocity);
        let rate_in_camera = across / position.norm();
        Motion { rate_in_camera, exposure_s: self.exposure.seconds() }
    }

    /// What its track says of a target at a time. Without a filter there is no track.
    pub(super) fn prior(&self, target: usize, at_s: f64) -> TrackPrior {
        match self.filter {
            FilterChoice::Tracks(_) => self.targets[target].prior(at_s, &self.ego),
            FilterChoice::None => TrackPrior::Untracked,
        }
    }
}
