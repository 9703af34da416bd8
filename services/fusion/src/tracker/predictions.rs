//! What tracks say of a time: where targets are, how they move as the camera sees them, and what
//! that changes in a measurement.

use flockeye_geometry::ego_rotation::CameraTurn;
use flockeye_geometry::filter::{MotionModel, Prediction};
use flockeye_imaging::align::Motion;
use nalgebra::{Isometry3, Matrix6, Vector6};

use super::{FilterChoice, Tracker};
use crate::measurement::Measurement;
use crate::readout::ApparentMotion;
use crate::track_prior::TrackPrior;

impl Tracker {
    /// The camera has turned. What was measured since then is filtered anew.
    pub fn turn_camera(&mut self, turn: &CameraTurn) {
        self.camera.ego.add(turn);
        self.targets
            .iter_mut()
            .for_each(|target| target.refilter(turn.earlier_s, &self.camera.ego));
    }

    /// Where a tracked target is at a time.
    pub fn prediction(&self, target: usize, at_s: f64) -> Option<Prediction> {
        match self.filter {
            FilterChoice::Tracks(_) => self.targets.get(target)?.predict(at_s, &self.camera.ego),
            FilterChoice::None => None,
        }
    }

    /// Where the picture of a frame that is exposed at a time will show each tracked target, by its
    /// number.
    pub fn predictions(&self, at_s: f64) -> impl Iterator<Item = (usize, Prediction)> {
        let targets = 0..self.targets.len();
        targets.filter_map(move |target| {
            let shown = self.prediction(target, self.shown_s(target, at_s))?;
            // The prediction stands for the frame, whenever the body's rows are exposed.
            Some((target, Prediction { stamp_s: at_s, ..shown }))
        })
    }

    /// When the rows are exposed that show a tracked target in the frame of a time, seconds.
    fn shown_s(&self, target: usize, at_s: f64) -> f64 {
        let Some(readout) = &self.camera.readout else { return at_s };
        let prediction = self.prediction(target, at_s);
        at_s + prediction.map_or(0.0, |known| readout.after_s(&known.camera_from_markers))
    }

    /// How a target with this pose moves as the camera sees it: as its track says, or as what
    /// stands still.
    pub(super) fn apparent_motion(
        &self,
        target: usize,
        at_s: f64,
        camera_from_markers: &Isometry3<f64>,
    ) -> ApparentMotion {
        // A late answer is of a time before the track's.
        let at_end = || self.prediction(target, self.ended?.1);
        match self.prediction(target, at_s).or_else(at_end) {
            Some(known) => ApparentMotion {
                velocity: known.apparent_velocity(),
                rate: known.rate - known.camera_rate,
                covariance: known.covariance.fixed_view::<6, 6>(6, 6).into_owned(),
            },
            None => {
                let position = &camera_from_markers.translation.vector;
                let turning = -self.camera.ego.rate_at(at_s);
                let motion = match self.filter {
                    FilterChoice::Tracks(policy) => policy.motion,
                    FilterChoice::None => MotionModel::default(),
                };
                let mut speed = motion.initial_speed.powi(2);
                if self.camera.ego.known_until_s().is_none() {
                    speed += (motion.initial_rate * position.norm()).powi(2);
                }
                let rate = motion.initial_rate.powi(2);
                let variances = Vector6::new(speed, speed, speed, rate, rate, rate);
                ApparentMotion {
                    velocity: turning.cross(position),
                    rate: turning,
                    covariance: Matrix6::from_diagonal(&variances),
                }
            }
        }
    }

    /// How a target moves across the line of sight while a frame is exposed, as far as its track
    /// says: no more than a confirmed one's `prior`.
    pub(super) fn motion(&self, target: usize, at_s: f64, prior: &TrackPrior) -> Motion {
        let prediction = prior.confirmed().and_then(|_| self.prediction(target, at_s));
        let Some(prediction) = prediction else { return Motion::default() };
        let position = prediction.camera_from_markers.translation.vector;
        let (sight, velocity) = (position.normalize(), prediction.apparent_velocity());
        let across = velocity - sight * sight.dot(&velocity);
        let rate_in_camera = across / position.norm();
        Motion { rate_in_camera, exposure_s: self.camera.exposure.seconds() }
    }

    /// What its track says of where the frame of a time shows a target. Without a filter there is
    /// no track.
    pub(super) fn prior(&self, target: usize, at_s: f64) -> TrackPrior {
        match self.filter {
            FilterChoice::Tracks(_) => {
                self.targets[target].prior(self.shown_s(target, at_s), &self.camera.ego)
            }
            FilterChoice::None => TrackPrior::Untracked,
        }
    }

    /// A target's measurement whose rays were right for `rays_m`, corrected to its own distance,
    /// and to the middle of the exposure at `at_s`.
    pub(super) fn corrected(
        &self,
        measurement: Measurement,
        rays_m: f64,
        target: usize,
        at_s: f64,
    ) -> Measurement {
        let mut pose = measurement.pose;
        if let Some(parallax) = &self.camera.parallax {
            pose = parallax.corrected(&pose, rays_m);
        }
        if let Some(readout) = &self.camera.readout {
            let shown = pose.camera_from_markers;
            let motion = self.apparent_motion(target, at_s, &shown);
            pose = motion.carried(&pose, -readout.after_s(&shown));
        }
        Measurement { pose, ..measurement }
    }
}
