//! One neighbour: its body and its track.

use flockeye_contract::FrameOrder;
use flockeye_geometry::body::Body;
use flockeye_geometry::ego_rotation::EgoRotation;
use flockeye_geometry::filter::{
    FilterError, Happened, LifeCycle, Prediction, TrackPolicy, TrackState,
};
use flockeye_geometry::pose::PosePrior;
use nalgebra::Vector3;

use crate::decide::outcome::may_enter_track;
use crate::measurement::{MeasuredBy, Measurement, PoseEstimate};
use crate::snapshot::SavedTarget;
use crate::track_prior::TrackPrior;

/// What is known of a target after a frame. Poses are of its markers in the camera frame.
#[derive(Debug, Clone, PartialEq)]
pub struct TargetEstimate {
    /// The filtered pose.
    pub pose: PoseEstimate,
    /// Its velocity in axes that do not turn, along the camera's, m/s.
    pub velocity: Vector3<f64>,
    /// Its angular velocity in axes that do not turn, along the camera's, rad/s.
    pub rate: Vector3<f64>,
    /// The frame's own measurement and how it was made, where the filter accepted one that is
    /// precise.
    pub measured: Option<(PoseEstimate, MeasuredBy)>,
    /// Markers decoded in this frame.
    pub markers: u32,
    /// State of the track. `None`: there is no filter, and the frame stands for itself.
    pub state: Option<TrackState>,
    /// Time since the track began, seconds.
    pub age_s: f64,
    /// Time since it was last measured, seconds.
    pub unseen_s: f64,
    /// Rises with each new track of this target.
    pub track_id: u32,
}

/// A target's number, and what is known of it after a frame.
pub type Update = (usize, TargetEstimate);

impl TargetEstimate {
    /// The estimate from one frame alone (`profile: stills`).
    pub fn of_frame(measurement: &Measurement) -> Self {
        let pose = measurement.pose;
        Self {
            pose,
            velocity: Vector3::zeros(),
            rate: Vector3::zeros(),
            measured: Some((pose, measurement.measured_by)),
            markers: measurement.markers,
            state: None,
            age_s: 0.0,
            unseen_s: 0.0,
            track_id: 0,
        }
    }
}

/// One configured body, seen or not.
#[derive(Debug, Clone)]
pub struct Target {
    /// Its body.
    pub body: Body,
    life: LifeCycle,
    track_id: u32,
}

impl Target {
    /// A target that was never seen.
    pub fn new(body: Body, policy: TrackPolicy) -> Self {
        let life = LifeCycle::new(policy);
        Self { body, life, track_id: 0 }
    }

    /// Predicts the target for a time, if it is tracked.
    pub fn predict(&self, at_s: f64, ego: &EgoRotation) -> Option<Prediction> {
        self.life.predict(at_s, ego)
    }

    /// Whether the target has a track.
    pub fn is_tracked(&self) -> bool {
        self.life.track().is_some()
    }

    /// The state of its track.
    pub fn state(&self) -> Option<TrackState> {
        self.life.state()
    }

    /// Forgets the track.
    pub fn forget(&mut self) {
        self.life.forget();
    }

    /// Its track for a successor, and how many it had. `published` is the newest frame in which its
    /// pose has left.
    pub fn saved(&self, published: Option<FrameOrder>) -> SavedTarget {
        SavedTarget {
            body: self.body.name.clone(),
            track_id: self.track_id,
            published,
            life: self.is_tracked().then(|| self.life.saved()),
        }
    }

    /// Goes on with a track of another process, or counts on from its last one.
    ///
    /// # Errors
    /// A track with numbers that are not finite: there is none then.
    pub fn resume(&mut self, saved: SavedTarget, ego: &EgoRotation) -> Result<(), FilterError> {
        self.track_id = saved.track_id;
        saved.life.map_or(Ok(()), |life| self.life.resume(life, ego))
    }

    /// Whether its track is confirmed and was measured in its last frame.
    pub fn is_measured(&self) -> bool {
        self.life.state() == Some(TrackState::Confirmed)
    }

    /// What its track predicts for a frame before the frame measures it.
    pub fn prior(&self, at_s: f64, ego: &EgoRotation) -> TrackPrior {
        let Some(prediction) = self.life.predict(at_s, ego) else { return TrackPrior::Untracked };
        let camera_from_markers = prediction.camera_from_markers;
        match self.life.state() {
            Some(TrackState::Confirmed | TrackState::Coasting) => {
                let covariance = prediction.pose_covariance();
                TrackPrior::Confirmed(PosePrior { camera_from_markers, covariance })
            }
            Some(TrackState::Tentative | TrackState::Lost) | None => {
                TrackPrior::Tentative(camera_from_markers)
            }
        }
    }

    /// Whether a measurement passes the track's gate.
    pub fn is_inside_gate(&self, at_s: f64, measurement: &Measurement, ego: &EgoRotation) -> bool {
        let pose = &measurement.pose;
        self.life.fits(at_s, &pose.camera_from_markers, &pose.covariance, ego)
    }

    /// Filters anew from a time since which it is known better how the camera has turned.
    pub fn refilter(&mut self, since_s: f64, ego: &EgoRotation) {
        self.life.refilter(since_s, ego);
    }

    /// Gives the filter a frame's measurement. `None` where the filter refuses it: its time lies
    /// before the track's history, its numbers are not finite, or it is imprecise and the track
    /// would not go on with it.
    pub fn update(
        &mut self,
        at_s: f64,
        measurement: &Measurement,
        ego: &EgoRotation,
    ) -> Option<TargetEstimate> {
        if !may_enter_track(measurement, || self.is_inside_gate(at_s, measurement, ego)) {
            return None;
        }
        let pose = &measurement.pose;
        let measured = measurement.is_precise.then_some((*pose, measurement.measured_by));
        match self.life.measured(at_s, &pose.camera_from_markers, &pose.covariance, ego) {
            Ok(Happened::Started | Happened::Restarted) => {
                self.track_id += 1;
                self.estimate(at_s, measured, measurement.markers, ego)
            }
            Ok(Happened::Updated(_)) => self.estimate(at_s, measured, measurement.markers, ego),
            Ok(Happened::Gated(_)) => self.estimate(at_s, None, measurement.markers, ego),
            Err(FilterError::Past { .. } | FilterError::Gap { .. }) => None,
            Err(FilterError::Unusable { .. } | FilterError::Gated { .. }) => None,
        }
    }

    /// Takes in that a frame did not measure the target. `None` if there is no track. The
    /// last estimate of a track has the state `Lost`.
    pub fn miss(&mut self, at_s: f64, markers: u32, ego: &EgoRotation) -> Option<TargetEstimate> {
        // A lost track has no pose any more, so its last message repeats the prediction from before.
        let before = self.estimate(at_s, None, markers, ego);
        match self.life.unseen(at_s, ego)? {
            TrackState::Lost => {
                self.life.forget();
                before.map(|before| TargetEstimate { state: Some(TrackState::Lost), ..before })
            }
            _ => self.estimate(at_s, None, markers, ego),
        }
    }

    fn estimate(
        &self,
        at_s: f64,
        measured: Option<(PoseEstimate, MeasuredBy)>,
        markers: u32,
        ego: &EgoRotation,
    ) -> Option<TargetEstimate> {
        let last_seen_s = self.life.last_seen_s()?;
        let track = self.life.track()?;
        // A clock that jumped back leaves nothing to predict; then the track's own time is used.
        let prediction = self.life.predict(at_s, ego).unwrap_or_else(|| track.now());
        Some(TargetEstimate {
            pose: PoseEstimate {
                camera_from_markers: prediction.camera_from_markers,
                covariance: prediction.pose_covariance(),
            },
            velocity: prediction.velocity,
            rate: prediction.rate,
            measured,
            markers,
            state: self.life.state(),
            age_s: (at_s - self.life.started_s()?).max(0.0),
            unseen_s: (at_s - last_seen_s).max(0.0),
            track_id: self.track_id,
        })
    }
}
