//! One neighbour: its body and its track.

use flockeye_contract::{FrameOrder, MeasuredBy};
use flockeye_geometry::body::Body;
use flockeye_geometry::camera::ShownBy;
use flockeye_geometry::ego_rotation::EgoRotation;
use flockeye_geometry::filter::{
    FilterError, FrameMeasurement, Happened, LifeCycle, MotionEstimate, RivalPose, SavedLife,
    TrackPolicy, TrackState,
};
use flockeye_geometry::pose::PoseEstimate;
use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use crate::decide::outcome::may_enter_track;
use crate::measurement::PoseMeasurement;
use crate::policy::{MARKERS_EVERY_FRAMES, SUSPENDED_FRAMES};
use crate::track_prior::TrackPrior;

/// Estimate of a target after a frame. Poses are of its markers in the camera frame.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct TargetEstimate {
    pub(crate) pose: PoseEstimate,
    /// Its velocity in axes that do not turn, along the camera's axes, m/s.
    pub(crate) velocity: Vector3<f64>,
    /// Its angular velocity in axes that do not turn, along the camera's axes, rad/s.
    pub(crate) rate: Vector3<f64>,
    /// The frame's own measurement and its source, if the filter accepted a precise one.
    pub(crate) measured: Option<(PoseEstimate, MeasuredBy)>,
    /// Markers decoded in this frame.
    pub(crate) markers: u32,
    /// Another pose that the target may have instead, if the track is ambiguous.
    pub(crate) rival: Option<RivalPose>,
    /// State of the track. `None` without a filter: the frame's measurement is the result.
    pub state: Option<TrackState>,
    /// Time since the track began, seconds.
    pub(crate) age_s: f64,
    /// Time since it was last measured, seconds.
    pub(crate) unseen_s: f64,
    /// Rises with each new track of this target.
    pub(crate) track_id: u32,
}

/// A target's number, with its estimate after a frame.
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
            rival: None,
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
    /// Number of frames for which its direct pass is still suspended.
    suspended_frames: u64,
    /// Number of consecutive frames that the direct pass has measured.
    direct_in_a_row: u32,
    /// What showed it in a stitched picture when it was measured last.
    shown_by: Option<ShownBy>,
}

/// State of a target for the next process.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct SavedTarget {
    pub(crate) body: String,
    /// The number of its newest track.
    pub(crate) track_id: u32,
    /// The newest frame in which its pose was published, if such frames may still be open.
    pub(crate) published: Option<FrameOrder>,
    /// The track, if it is tracked.
    pub(crate) life: Option<SavedLife>,
}

impl Target {
    /// Creates a target before its first measurement.
    pub(crate) fn new(body: Body, policy: TrackPolicy) -> Self {
        let life = LifeCycle::new(policy);
        let (track_id, suspended_frames, direct_in_a_row, shown_by) = (0, 0, 0, None);
        Self { body, life, track_id, suspended_frames, direct_in_a_row, shown_by }
    }

    /// Suspends its direct pass, because markers contradicted one of its poses.
    pub(crate) fn suspend_direct_pass(&mut self) {
        self.suspended_frames = SUSPENDED_FRAMES;
    }

    /// Whether it must wait for its markers.
    pub(crate) fn is_suspended(&self) -> bool {
        self.suspended_frames > 0
    }

    /// Ends a frame, with or without a measurement by the direct pass.
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

    /// Whether its track was not measured for some frames, so that it may be elsewhere.
    pub(crate) fn is_stale(&self) -> bool {
        self.life.is_stale()
    }

    /// The state of its track.
    pub fn state(&self) -> Option<TrackState> {
        self.life.state()
    }

    pub(crate) fn forget(&mut self) {
        self.life.forget();
    }

    /// Its track for a successor, and its number of tracks. `published` is the newest frame in
    /// which its pose was published.
    pub(crate) fn saved(&self, published: Option<FrameOrder>) -> SavedTarget {
        SavedTarget {
            body: self.body.name.clone(),
            track_id: self.track_id,
            published,
            life: self.is_tracked().then(|| self.life.saved()),
        }
    }

    /// Continues a track of another process, or the number of its last one.
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

    /// The track's prediction for a frame before the frame measures it.
    pub(crate) fn prior(&self, at_s: f64, ego: &EgoRotation) -> TrackPrior {
        let Some(prediction) = self.life.predict(at_s, ego) else { return TrackPrior::Untracked };
        let predicted = prediction.pose();
        let rival = self.predict_rival(at_s, ego).map(|rival| rival.pose.camera_from_markers);
        match self.life.state() {
            Some(TrackState::Confirmed | TrackState::Coasting) if rival.is_none() => {
                TrackPrior::Confirmed(predicted)
            }
            _ => TrackPrior::Tentative { predicted, rival },
        }
    }

    /// Another pose that an ambiguous target may have instead at a time.
    pub(crate) fn predict_rival(&self, at_s: f64, ego: &EgoRotation) -> Option<RivalPose> {
        self.life.predict_rival(at_s, ego)
    }

    /// Whether the track accepts a measurement: it passes the gate, or replaces a stale track.
    pub(crate) fn accepts(
        &self,
        at_s: f64,
        measurement: &PoseMeasurement,
        ego: &EgoRotation,
    ) -> bool {
        self.life.accepts(at_s, &self.in_life(measurement), ego)
    }

    /// Filters anew from a time, because the camera's rotation since then is known better.
    pub(crate) fn refilter(&mut self, since_s: f64, ego: &EgoRotation) {
        self.life.refilter(since_s, ego);
    }

    /// Corrects the poses of its track, and filters anew.
    pub(crate) fn correct(
        &mut self,
        corrected: impl Fn(&PoseEstimate) -> PoseEstimate,
        ego: &EgoRotation,
    ) {
        self.life.correct(corrected, ego);
    }

    /// Updates the filter with a frame's measurement. `None` if the filter refuses it: its time
    /// lies before the track's history, its numbers are not finite, or it is imprecise and would
    /// not continue the track.
    pub(crate) fn update(
        &mut self,
        at_s: f64,
        measurement: &PoseMeasurement,
        ego: &EgoRotation,
    ) -> Option<TargetEstimate> {
        if !may_enter_track(measurement, || self.accepts(at_s, measurement, ego)) {
            return None;
        }
        let pose = &measurement.pose;
        let measured = measurement.is_usable_alone().then_some((*pose, measurement.measured_by));
        let in_life = self.in_life(measurement);
        let happened = self.life.measured(at_s, &in_life, ego);
        if let Ok(Happened::Started | Happened::Restarted | Happened::Updated) = happened {
            self.shown_by = measurement.shown.map(|shown| shown.by);
        }
        match happened {
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

    /// A measurement as the track's life takes it.
    fn in_life(&self, measurement: &PoseMeasurement) -> FrameMeasurement {
        let PoseMeasurement { pose, rival, is_proven, shown, .. } = *measurement;
        let jump = shown.zip(self.shown_by).and_then(|(now, before)| now.jump_since(before));
        FrameMeasurement { pose, rival, is_proven, jump }
    }

    /// Handles a frame without a measurement of the target. `None` if there is no track. The last
    /// estimate of a track has the state `Lost`.
    pub(crate) fn miss(
        &mut self,
        at_s: f64,
        markers: u32,
        ego: &EgoRotation,
    ) -> Option<TargetEstimate> {
        // A lost track has no pose, so its last message repeats the earlier prediction.
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
        // After a clock jump back there is no prediction, so the track's own time is used.
        let prediction = self.life.predict(at_s, ego).unwrap_or_else(|| track.clone());
        let rival = self.predict_rival(at_s, ego);
        Some(TargetEstimate {
            pose: prediction.pose(),
            velocity: prediction.velocity,
            rate: prediction.rate,
            measured: measured.filter(|_| rival.is_none()),
            markers,
            rival,
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
