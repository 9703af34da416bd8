//! Predictions of tracks for a time: places and apparent motion of targets, and corrections of
//! measurements.

use flockeye_contract::MeasuredBy;
use flockeye_geometry::camera::ShownBy;
use flockeye_geometry::ego_rotation::CameraTurn;
use flockeye_geometry::filter::{MotionEstimate, MotionModel, RivalPose};
use flockeye_geometry::pose::PoseEstimate;
use flockeye_imaging::align::Motion;
use nalgebra::{Matrix6, Vector6};

use super::Tracker;
use crate::measurement::{PoseMeasurement, Shown};
use crate::readout::{after_s, carried};
use crate::track_prior::TrackPrior;

impl Tracker {
    /// Handles a rotation of the camera. Measurements since then are filtered anew.
    pub(crate) fn turn_camera(&mut self, turn: &CameraTurn) {
        self.camera.ego.add(turn);
        self.targets
            .iter_mut()
            .for_each(|target| target.refilter(turn.earlier_s, &self.camera.ego));
    }

    /// Predicted pose of a tracked target at a time.
    pub fn prediction(&self, target: usize, at_s: f64) -> Option<MotionEstimate> {
        self.filter?;
        self.targets.get(target)?.predict(at_s, &self.camera.ego)
    }

    /// Another pose that an ambiguous target may have instead at a time.
    pub(crate) fn rival(&self, target: usize, at_s: f64) -> Option<RivalPose> {
        self.filter?;
        self.targets.get(target)?.predict_rival(at_s, &self.camera.ego)
    }

    /// Prediction of each tracked target as the picture of a frame with this exposure will show it,
    /// by its number.
    pub(crate) fn predictions(&self, at_s: f64) -> impl Iterator<Item = (usize, MotionEstimate)> {
        let targets = 0..self.targets.len();
        targets.filter_map(move |target| {
            let shown = self.prediction(target, self.shown_s(target, at_s))?;
            // The prediction applies to the frame, for any exposure of the body's rows.
            Some((target, MotionEstimate { stamp_s: at_s, ..shown }))
        })
    }

    /// Exposure time of the rows that show a tracked target in the frame of a time, seconds.
    fn shown_s(&self, target: usize, at_s: f64) -> f64 {
        let Some((camera, readout_s)) = &self.camera.readout else { return at_s };
        let prediction = self.prediction(target, at_s);
        at_s + prediction
            .map_or(0.0, |known| after_s(camera, *readout_s, &known.camera_from_markers))
    }

    /// A target's pose at a time, extrapolated by `by_s` seconds: with the velocity of its track
    /// or, without one, as at rest.
    fn carried(&self, target: usize, at_s: f64, pose: &PoseEstimate, by_s: f64) -> PoseEstimate {
        // A late answer has a time before the track's.
        let at_end = || self.prediction(target, self.ended?.1);
        if let Some(known) = self.prediction(target, at_s).or_else(at_end) {
            let (velocity, rate) = (known.apparent_velocity(), known.rate - known.camera_rate);
            let covariance = known.covariance.fixed_view::<6, 6>(6, 6).into_owned();
            return carried(pose, (&velocity, &rate), &covariance, by_s);
        }
        let position = &pose.camera_from_markers.translation.vector;
        let turning = -self.camera.ego.rate_at(at_s);
        let motion = self.filter.map_or_else(MotionModel::default, |policy| policy.motion);
        let mut speed = motion.initial_speed.powi(2);
        if self.camera.ego.known_until_s().is_none() {
            speed += (motion.initial_rate * position.norm()).powi(2);
        }
        let rate = motion.initial_rate.powi(2);
        let variances = Vector6::new(speed, speed, speed, rate, rate, rate);
        let velocity = turning.cross(position);
        carried(pose, (&velocity, &turning), &Matrix6::from_diagonal(&variances), by_s)
    }

    /// Motion of a target across the line of sight during a frame's exposure, from its track:
    /// limited to a confirmed track's `prior`.
    pub(super) fn motion(&self, target: usize, at_s: f64, prior: &TrackPrior) -> Motion {
        let prediction = prior.confirmed().and_then(|_| self.prediction(target, at_s));
        let Some(prediction) = prediction else { return Motion::default() };
        let position = prediction.camera_from_markers.translation.vector;
        let (sight, velocity) = (position.normalize(), prediction.apparent_velocity());
        let across = velocity - sight * sight.dot(&velocity);
        let rate_in_camera = across / position.norm();
        Motion { rate_in_camera, exposure_s: self.camera.exposure.seconds() }
    }

    /// Its track's prediction of the target as the picture of the frame at a time shows it. Without
    /// a filter there is no track.
    pub(super) fn prior(&self, target: usize, at_s: f64) -> TrackPrior {
        match self.filter {
            Some(_) => self.targets[target].prior(self.shown_s(target, at_s), &self.camera.ego),
            None => TrackPrior::Untracked,
        }
    }

    /// A target's measurement from rays that were exact for `rays_m`, corrected to its own
    /// distance, and to the middle of the exposure at `at_s`.
    pub(super) fn corrected(
        &self,
        measurement: PoseMeasurement,
        rays_m: f64,
        target: usize,
        at_s: f64,
    ) -> PoseMeasurement {
        let corrected = |pose: PoseEstimate| {
            let parallax = self.camera.parallax.as_ref();
            let pose = parallax.map_or(pose, |parallax| parallax.corrected(&pose, rays_m));
            // An alignment has its camera's lenses in its model.
            let is_aligned = measurement.measured_by == MeasuredBy::Aligned;
            let stitching = self.camera.stitching.as_ref().filter(|_| !is_aligned);
            let pose = stitching.map_or(pose, |it| it.current().corrected(&pose, rays_m));
            let Some((camera, readout_s)) = &self.camera.readout else { return pose };
            let after_s = after_s(camera, *readout_s, &pose.camera_from_markers);
            self.carried(target, at_s, &pose, -after_s)
        };
        let pose = corrected(measurement.pose);
        let rival = measurement.rival.map(|RivalPose { pose, lead }| {
            let pose = corrected(pose);
            RivalPose { pose, lead }
        });
        let shown = self.camera.stitching.as_ref().map(|stitching| {
            let place = pose.camera_from_markers.translation.vector;
            let by = ShownBy::of(&place, self.targets[target].body.radius());
            Shown { by, covariance: stitching.current().pose_covariance(&place) }
        });
        PoseMeasurement { pose, rival, shown, ..measurement }
    }
}
