//! One neighbour: its body and its track.

use flockeye_contract::{FrameOrder, MeasuredBy};
use flockeye_geometry::body::Body;
use flockeye_geometry::ego_rotation::EgoRotation;
use flockeye_geometry::filter::{
    FilterError, Happened, LifeCycle, MotionEstimate, SavedLife, TrackPolicy, TrackState,
};
use flockeye_geometry::pose::PoseEstimate;
use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use crate::decide::outcome::may_enter_track;
use crate::measurement::PoseMeasurement;
use crate::policy::{MARKERS_EVERY_FRAMES, SUSPENDED_FRAMES};
use crate::track_prior::TrackPrior;

/// What is known of a target after a frame. Poses are of its markers in the camera frame.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct TargetEstimate {
    pub(crate) pose: PoseEstimate,
    /// Its velocity in axes that do not turn, along the camera's, m/s.
    pub(crate) velocity: Vector3<f64>,
    /// Its angular velocity in axes that do not turn, along the camera's, rad/s.
    pub(crate) rate: Vector3<f64>,
    /// The frame's own measurement and how it was made, where the filter accepted one that is
    /// precise.
    pub(crate) measured: Option<(PoseEstimate, MeasuredBy)>,
    /// Markers decoded in this frame.
    pub(crate) markers: u32,
    /// State of the track. `None`: there is no filter, and the frame stands for itself.
    pub state: Option<TrackState>,
    /// Time since the track began, seconds.
    pub(crate) age_s: f64,
    /// Time since it was last measured, seconds.
    pub(crate) unseen_s: f64,
    /// Rises with each new track of this target.
    pub(crate) track_id: u32,
}

/// A target's number, and what is known of it after a frame.
pub(crate) type Update = (usize, TargetEstimate);

impl TargetEstimate {
    /// The estimate from one frame alone (`profile: stills`).
    pub(crate) fn of_frame(measurement: &PoseMeasurement) -> Self {
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
    pub(crate) body: Body,
    life: LifeCycle,
    track_id: u32,
    /// For how many more frames its direct pass is suspended.
    suspended_frames: u64,
    /// In how many frames in a row the direct pass has measured it.
    direct_in_a_row: u32,
}

/// A target, as a process leaves it to its successor.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct SavedTarget {
    pub(crate) body: String,
    /// The number of its newest track.
    pub(crate) track_id: u32,
    /// The newest frame in which its pose has left, as far as such frames may still be open.
    pub(crate) published: Option<FrameOrder>,
    /// The track, if it is tracked.
    pub(crate) life: Option<SavedLife>,
}

impl Target {
    /// A target that was never seen.
    pub(crate) fn new(body: Body, policy: TrackPolicy) -> Self {
        let life = LifeCycle::new(policy);
        Self { body, life, track_id: 0, suspended_frames: 0, direct_in_a_row: 0 }
    }

    /// Suspends its direct pass, because markers contradicted a pose of it.
    pub(crate) fn suspend_direct_pass(&mut self) {
        self.suspended_frames = SUSPENDED_FRAMES;
    }

    /// Whether it has to wait for its markers.
    pub(crate) fn is_suspended(&self) -> bool {
        self.suspended_frames > 0
    }

    /// Ends a frame, which the direct pass has measured or not.
    pub(crate) fn end_frame(&mut self, is_measured_directly: bool) {
        self.suspended_frames = self.suspended_frames.saturating_sub(1);
        self.direct_in_a_row =
            if is_measured_directly { self.direct_in_a_row.wrapping_add(1) } else { 0 };
    }

    /// Whether its region of interest need not be searched for markers in the next frame. `number`
    /// is its own, so that not all are searched in the same frame.
    pub(crate) fn needs_no_markers(&self, number: usize) -> bool {
        let turn = self.direct_in_a_row.wrapping_add(number as u32);
        self.direct_in_a_row > 0
            && !self.is_suspended()
            && !turn.is_multiple_of(MARKERS_EVERY_FRAMES)
    }

    /// Predicts the target for a time, if it is tracked.
    pub(crate) fn predict(&self, at_s: f64, ego: &EgoRotation) -> Option<MotionEstimate> {
        self.life.predict(at_s, ego)
    }

    /// Whether the target has a track.
    pub(crate) fn is_tracked(&self) -> bool {
        self.life.track().is_some()
    }

    /// The state of its track.
    pub fn state(&self) -> Option<TrackState> {
        self.life.state()
    }

    pub(crate) fn forget(&mut self) {
        self.life.forget();
    }

    /// Its track for a successor, and how many it had. `published` is the newest frame in which its
    /// pose has left.
    pub(crate) fn saved(&self, published: Option<FrameOrder>) -> SavedTarget {
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
    pub(crate) fn resume(
        &mut self,
        saved: SavedTarget,
        ego: &EgoRotation,
    ) -> Result<(), FilterError> {
        self.track_id = saved.track_id;
        saved.life.map_or(Ok(()), |life| self.life.resume(life, ego))
    }

    /// Whether its track is confirmed and was measured in its last frame.
    pub(crate) fn is_measured(&self) -> bool {
        self.life.state() == Some(TrackState::Confirmed)
    }

    /// What its track predicts for a frame before the frame measures it.
    pub(crate) fn prior(&self, at_s: f64, ego: &EgoRotation) -> TrackPrior {
        let Some(prediction) = self.life.predict(at_s, ego) else { return TrackPrior::Untracked };
        let camera_from_markers = prediction.camera_from_markers;
        match self.life.state() {
            Some(TrackState::Confirmed | TrackState::Coasting) => {
                let covariance = prediction.pose_covariance();
                TrackPrior::Confirmed(PoseEstimate { camera_from_markers, covariance })
            }
            Some(TrackState::Tentative | TrackState::Lost) | None => {
                TrackPrior::Tentative(camera_from_markers)
            }
        }
    }

    /// Whether a measurement passes the track's gate.
    pub(crate) fn is_inside_gate(
        &self,
        at_s: f64,
        measurement: &PoseMeasurement,
        ego: &EgoRotation,
    ) -> bool {
        let pose = &measurement.pose;
        self.life.fits(at_s, pose, ego)
    }

    /// Filters anew from a time since which it is known better how the camera has turned.
    pub(crate) fn refilter(&mut self, since_s: f64, ego: &EgoRotation) {
        self.life.refilter(since_s, ego);
    }

    /// Gives the filter a frame's measurement. `None` where the filter refuses it: its time lies
    /// before the track's history, its numbers are not finite, or it is imprecise and the track
    /// would not go on with it.
    pub(crate) fn update(
        &mut self,
        at_s: f64,
        measurement: &PoseMeasurement,
        ego: &EgoRotation,
    ) -> Option<TargetEstimate> {
        if !may_enter_track(measurement, || self.is_inside_gate(at_s, measurement, ego)) {
            return None;
        }
        let pose = &measurement.pose;
        let measured = measurement.is_precise.then_some((*pose, measurement.measured_by));
        match self.life.measured(at_s, pose, ego) {
            Ok(Happened::Started | Happened::Restarted) => {
                self.track_id += 1;
                self.estimate(at_s, measured, measurement.markers, ego)
            }
            Ok(Happened::Updated) => self.estimate(at_s, measured, measurement.markers, ego),
            Ok(Happened::Gated) => self.estimate(at_s, None, measurement.markers, ego),
            Err(FilterError::Past { .. } | FilterError::Gap { .. }) => None,
            Err(FilterError::Unusable { .. } | FilterError::Gated { .. }) => None,
        }
    }

    /// Takes in that a frame did not measure the target. `None` if there is no track. The
    /// last estimate of a track has the state `Lost`.
    pub(crate) fn miss(
        &mut self,
        at_s: f64,
        markers: u32,
        ego: &EgoRotation,
    ) -> Option<TargetEstimate> {
        // A lost track has no pose any more, so its last message repeats the prediction from
        // before.
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
        let prediction = self.life.predict(at_s, ego).unwrap_or_else(|| track.clone());
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixtures::{alpha, bravo};

    fn both() -> [Target; 2] {
        [alpha(), bravo()].map(|body| Target::new(body, TrackPolicy::default()))
    }

    #[test]
    fn markers_are_searched_in_every_fourth_frame_by_turns() {
        let mut targets = both();
        assert!(!targets[0].needs_no_markers(0), "nothing is known yet");
        let mut searched = [0, 0];
        let mut together = 0;
        for _ in 0..40 {
            targets.iter_mut().for_each(|target| target.end_frame(true));
            let now = [0, 1].map(|number| !targets[number].needs_no_markers(number));
            searched = [0, 1].map(|k| searched[k] + u32::from(now[k]));
            together += u32::from(now == [true, true]);
        }
        assert_eq!((searched, together), ([10, 10], 0));
    }

    #[test]
    fn suspended_and_missed_targets_are_searched_for_markers() {
        let [mut alpha, mut bravo] = both();
        alpha.end_frame(true);
        bravo.end_frame(true);
        assert!(alpha.needs_no_markers(0) && bravo.needs_no_markers(1));
        alpha.suspend_direct_pass();
        assert!(alpha.is_suspended() && !alpha.needs_no_markers(0));
        alpha.end_frame(true);
        bravo.end_frame(false);
        assert!(!bravo.needs_no_markers(1), "the last frame did not measure it");
        (0..SUSPENDED_FRAMES).for_each(|_| alpha.end_frame(true));
        assert!(!alpha.is_suspended());
    }
}
