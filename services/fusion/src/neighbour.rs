//! A neighbour's track from frame to frame.

use flockeye_geometry::body::Body;
use flockeye_geometry::filter::{
    FilterError, Happened, LifeCycle, Prediction, TrackPolicy, TrackState,
};
use flockeye_geometry::pose::PosePrior;
use nalgebra::{Isometry3, Matrix6, Vector3};

use crate::sighting::{MeasuredBy, Sighting};

/// What is known of a neighbour after a frame. Poses are of its markers in the camera frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Known {
    /// Where it is.
    pub pose: PoseEstimate,
    /// Its velocity in the camera frame's axes, m/s.
    pub velocity: Vector3<f64>,
    /// Its angular velocity in the camera frame's axes, rad/s.
    pub rate: Vector3<f64>,
    /// The frame's own measurement, where it was believed, and what it was measured by.
    pub measured: Option<(PoseEstimate, MeasuredBy)>,
    /// Markers decoded in this frame.
    pub markers: u32,
    /// State of the track; `None`: there is no filter, the frame stands for itself.
    pub state: Option<TrackState>,
    /// Time since the track began, seconds.
    pub age_s: f64,
    /// Time since it was last measured, seconds.
    pub unseen_s: f64,
    /// Rises with each new track of this neighbour.
    pub track_id: u32,
}

/// A pose and how sure it is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseEstimate {
    /// The pose of the markers in the camera frame.
    pub camera_from_markers: Isometry3<f64>,
    /// Position (m), then rotation vector (rad), in the camera frame's axes.
    pub covariance: Matrix6<f64>,
}

/// One configured body, seen or not.
#[derive(Debug, Clone)]
pub struct Neighbour {
    /// Its body.
    pub body: Body,
    life: LifeCycle,
    track_id: u32,
}

impl Neighbour {
    /// Never seen yet.
    pub fn new(body: Body, policy: TrackPolicy) -> Self {
        Self { body, life: LifeCycle::new(policy), track_id: 0 }
    }

    /// Where it will be at a time, if it is tracked.
    pub fn predict(&self, at_s: f64) -> Option<Prediction> {
        self.life.predict(at_s)
    }

    /// Whether it has a track.
    pub fn is_tracked(&self) -> bool {
        self.life.track().is_some()
    }

    /// Forgets all that was seen of it, and not seen.
    pub fn forget(&mut self) {
        self.life.forget();
    }

    /// Whether its track is believed and was measured in its last frame.
    pub fn is_measured(&self) -> bool {
        self.life.state() == Some(TrackState::Confirmed)
    }

    /// What its track, once believed, says of a frame before it is measured.
    pub fn prior(&self, at_s: f64) -> Option<PosePrior> {
        let is_believed =
            matches!(self.life.state(), Some(TrackState::Confirmed | TrackState::Coasting));
        let prediction = self.life.predict(at_s).filter(|_| is_believed)?;
        Some(PosePrior {
            camera_from_markers: prediction.observer_from_target,
            covariance: prediction.pose_covariance(),
        })
    }

    /// Whether a sighting is one that its track expects.
    pub fn expects(&self, at_s: f64, sighting: &Sighting) -> bool {
        let pose = &sighting.pose;
        self.life.fits(at_s, &pose.camera_from_markers, &pose.covariance)
    }

    /// A frame shows it. `None` where the measurement can mean nothing (a time that lies before
    /// the track's, numbers that are none).
    pub fn seen(&mut self, at_s: f64, sighting: &Sighting) -> Option<Known> {
        let pose = &sighting.pose;
        let measured = (*pose, sighting.measured_by);
        let outcome = self.life.measured(at_s, &pose.camera_from_markers, &pose.covariance);
        match outcome {
            Ok(Happened::Started | Happened::Restarted) => {
                self.track_id += 1;
                self.known(at_s, Some(measured), sighting.markers)
            }
            Ok(Happened::Updated(_)) => self.known(at_s, Some(measured), sighting.markers),
            Ok(Happened::Gated(_)) => self.known(at_s, None, sighting.markers),
            Err(FilterError::Past { .. } | FilterError::Gap { .. }) => None,
            Err(FilterError::Unusable { .. } | FilterError::Gated { .. }) => None,
        }
    }

    /// A frame does not show it. `None` if there is no track; the last message of one is `Lost`.
    pub fn unseen(&mut self, at_s: f64, markers: u32) -> Option<Known> {
        // What is said of a lost track is where it was believed to be before.
        let before = self.known(at_s, None, markers);
        match self.life.unseen(at_s)? {
            TrackState::Lost => {
                self.life.forget();
                before.map(|known| Known { state: Some(TrackState::Lost), ..known })
            }
            _ => self.known(at_s, None, markers),
        }
    }

    fn known(
        &self,
        at_s: f64,
        measured: Option<(PoseEstimate, MeasuredBy)>,
        markers: u32,
    ) -> Option<Known> {
        let last_seen_s = self.life.last_seen_s()?;
        // A clock that jumped back leaves nothing to predict: what was known last is said then.
        let track = self.life.track()?;
        let prediction = self.life.predict(at_s).unwrap_or_else(|| track.now());
        Some(Known {
            pose: PoseEstimate {
                camera_from_markers: prediction.observer_from_target,
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

impl Known {
    /// What one frame alone says (`fusion.filter: none`).
    pub fn of_frame(sighting: &Sighting) -> Self {
        let pose = sighting.pose;
        Self {
            pose,
            velocity: Vector3::zeros(),
            rate: Vector3::zeros(),
            measured: Some((pose, sighting.measured_by)),
            markers: sighting.markers,
            state: None,
            age_s: 0.0,
            unseen_s: 0.0,
            track_id: 0,
        }
    }
}
