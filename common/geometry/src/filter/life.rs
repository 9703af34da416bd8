//! The life of a track: what is believed of a neighbour after each frame of the last half second.

use std::cmp::Ordering;
use std::collections::VecDeque;

use nalgebra::Matrix6;
use serde::{Deserialize, Serialize};

use crate::ego_rotation::EgoRotation;
use crate::pose::{PoseEstimate, pose_difference};

use super::belief::Belief;
use super::{FilterError, MotionEstimate, MotionModel, check};

/// State of a track in its life.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum TrackState {
    /// Measured too few times to be confirmed.
    Tentative,
    /// Confirmed, and measured in the last frame.
    Confirmed,
    /// Confirmed, but not measured in the last frame.
    Coasting,
    /// Without a measurement for too long.
    Lost,
}

/// Largest delay of a frame after newer ones with which it is still sorted in, seconds.
pub const HISTORY_S: f64 = 0.5;

/// Conditions under which a track is confirmed and lost.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackPolicy {
    /// Motion model of the neighbour.
    pub motion: MotionModel,
    /// Number of accepted measurements that confirm a track, the first included, among
    /// [`super::CONFIRM_WINDOW`] frames.
    pub confirm_hits: u32,
    /// Longest time without a measurement before a confirmed track is lost, seconds.
    pub coast_s: f64,
}

impl Default for TrackPolicy {
    /// The defaults of pipeline.yaml.
    fn default() -> Self {
        Self { motion: MotionModel::default(), confirm_hits: 2, coast_s: 1.0 }
    }
}

/// Effect of a measurement.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Happened {
    /// The measurement started a track where there was none, or a lost one.
    Started,
    /// The measurement updated the track.
    Updated,
    /// The measurement lay outside the gate. The target counts as not seen in this frame.
    Gated,
    /// What contradicted the track is now likelier than the track, or the clock jumped back: a new
    /// track replaces it.
    Restarted,
}

/// The track of one neighbour and its state. Call [`LifeCycle::measured`] or
/// [`LifeCycle::unseen`] once for each frame.
///
/// Frames may come late and in any order. Their results are kept for [`HISTORY_S`], with the state
/// after each. After a late frame, all later results are filtered anew. So within the history the
/// order of arrival does not matter.
#[derive(Debug, Clone, PartialEq)]
pub struct LifeCycle {
    pub(super) policy: TrackPolicy,
    /// State before the first event of the history.
    pub(super) base: Option<Belief>,
    /// Events by time. After the first event, the newest is always kept.
    pub(super) events: VecDeque<HistoryEntry>,
}

/// Result of a frame, and the state after it.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct HistoryEntry {
    pub(super) stamp_s: f64,
    /// `None` if the frame did not show the neighbour.
    pub(super) measured: Option<FrameMeasurement>,
    pub(super) after: Option<Belief>,
}

/// A frame's measured pose of a neighbour.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct FrameMeasurement {
    /// The likeliest pose.
    pub pose: PoseEstimate,
    /// Another pose, which the frame does not exclude.
    pub rival: Option<RivalPose>,
    /// Whether the picture alone proves the pose, so that it may replace a stale track.
    pub is_proven: bool,
    /// Covariance of a jump of all measured poses since the last measurement, as of a body that comes
    /// before another lens: position (m), then rotation vector (rad).
    pub jump: Option<Matrix6<f64>>,
}

/// A pose of a neighbour that may be the right one instead of a likelier one. Of the two, one is
/// false if the other is true, for example mirror poses of a flat marker.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct RivalPose {
    /// The pose.
    pub pose: PoseEstimate,
    /// Log odds of the likelier pose against this one, at least 0.
    pub lead: f64,
}

impl RivalPose {
    /// Covariance of a pose that has this rival: the expected square of its error, with either of
    /// the two as the truth.
    pub fn covariance_beside(&self, best: &PoseEstimate) -> Matrix6<f64> {
        let rival = &self.pose;
        let share = 1.0 / (1.0 + self.lead.exp());
        let between = pose_difference(&rival.camera_from_markers, &best.camera_from_markers);
        best.covariance * (1.0 - share) + (rival.covariance + between * between.transpose()) * share
    }
}

impl LifeCycle {
    /// Creates a life without any measurement.
    pub fn new(policy: TrackPolicy) -> Self {
        Self { policy, base: None, events: VecDeque::new() }
    }

    /// State of the track; `None` before the first measurement.
    pub fn state(&self) -> Option<TrackState> {
        self.belief().map(Belief::state)
    }

    /// The filter, while the track is alive.
    pub fn track(&self) -> Option<&MotionEstimate> {
        self.belief().and_then(Belief::alive)
    }

    /// Whether the track had no accepted measurement in the last
    /// [`STALE_AFTER_FRAMES`](super::STALE_AFTER_FRAMES) frames.
    pub fn is_stale(&self) -> bool {
        self.belief().is_some_and(Belief::is_stale)
    }

    /// Exposure time of the track's first measurement, seconds.
    pub fn started_s(&self) -> Option<f64> {
        self.belief().map(Belief::started_s)
    }

    /// Exposure time of the last accepted measurement, seconds; also of a lost track.
    pub fn last_seen_s(&self) -> Option<f64> {
        self.belief().map(Belief::last_seen_s)
    }

    /// Predicts the neighbour at `at_s`. For a time within the history, returns its state then,
    /// from the frames up to that time. `None` without a live track, or if the filter has no result
    /// for that time.
    pub fn predict(&self, at_s: f64, ego: &EgoRotation) -> Option<MotionEstimate> {
        let track = self.track()?;
        if at_s >= track.stamp_s {
            return track.predict(at_s, &self.policy.motion, ego).ok();
        }
        self.belief_at(at_s)?.alive()?.predict(at_s, &self.policy.motion, ego).ok()
    }

    /// Predicts the rival of [`Self::predict`] for a time, if the track is ambiguous then: the
    /// likelier pose does not lead by [`least_lead`](crate::pose::least_lead).
    pub fn predict_rival(&self, at_s: f64, ego: &EgoRotation) -> Option<RivalPose> {
        self.belief_at(at_s)?.predict_rival(at_s, &self.policy.motion, ego)
    }

    /// Handles a frame exposed at `stamp_s` with a measured pose of the neighbour. It replaces an
    /// earlier result of the same frame without a measurement.
    ///
    /// A frame from before the history is refused. If it is earlier by more than `coast_s`, the
    /// clock must have jumped, so the track starts anew.
    ///
    /// # Errors
    /// An unusable measurement ([`FilterError::Unusable`]) or one from too long ago
    /// ([`FilterError::Past`]); nothing changes then.
    pub fn measured(
        &mut self,
        stamp_s: f64,
        measured: &FrameMeasurement,
        ego: &EgoRotation,
    ) -> Result<Happened, FilterError> {
        // A measurement must be good enough to start a track.
        check(stamp_s, &measured.pose)?;
        let mut jumped = false;
        if let Some(newest_s) = self.too_late(stamp_s) {
            if !self.is_jump(newest_s - stamp_s) {
                return Err(FilterError::Past { at_s: stamp_s, stamp_s: newest_s });
            }
            jumped = self.track().is_some();
            self.forget();
        }
        let (place, mut event) = self.placed(stamp_s, Some(*measured));
        let (happened, _) =
            Belief::measured(&mut event.after, stamp_s, measured, &self.policy, ego)?;
        self.insert(place, event, ego);
        Ok(if jumped { Happened::Restarted } else { happened })
    }

    /// Whether the track would accept a measurement at `stamp_s`: it lies inside the gate of a branch,
    /// or it is proven and the track begins anew from it.
    pub fn accepts(&self, stamp_s: f64, measured: &FrameMeasurement, ego: &EgoRotation) -> bool {
        if self.too_late(stamp_s).is_some() {
            return false;
        }
        let (_, HistoryEntry { mut after, .. }) = self.placed(stamp_s, Some(*measured));
        match Belief::measured(&mut after, stamp_s, measured, &self.policy, ego) {
            Ok((Happened::Restarted, fits)) => fits || measured.is_proven,
            Ok((_, fits)) => fits,
            Err(_) => false,
        }
    }

    /// Handles a frame exposed at `stamp_s` without a measurement of the neighbour, although all
    /// planned views were searched. Returns the state after all frames so far. A frame from before
    /// the history changes nothing, nor does one that already has a measurement.
    pub fn unseen(&mut self, stamp_s: f64, ego: &EgoRotation) -> Option<TrackState> {
        if let Some(newest_s) = self.too_late(stamp_s) {
            if self.is_jump(newest_s - stamp_s) {
                // After a clock jump back, the track is meaningless.
                let mut belief = self.belief().cloned();
                belief.iter_mut().for_each(Belief::lose);
                self.events.clear();
                self.base = belief;
            }
        } else if stamp_s.is_finite() && !self.events.iter().any(|event| event.stamp_s == stamp_s) {
            let (place, mut event) = self.placed(stamp_s, None);
            event.step(&self.policy, ego);
            self.insert(place, event, ego);
        }
        self.state()
    }

    /// Filters anew all events from `since_s` on, because the camera's rotation since then is known
    /// better now.
    pub fn refilter(&mut self, since_s: f64, ego: &EgoRotation) {
        let first = self.events.partition_point(|event| event.stamp_s < since_s);
        self.refilter_from(first, ego);
    }

    /// Corrects the poses of all measurements, and of the state before them, and filters anew.
    pub fn correct(
        &mut self,
        corrected: impl Fn(&PoseEstimate) -> PoseEstimate,
        ego: &EgoRotation,
    ) {
        self.base.iter_mut().for_each(|belief| belief.correct(&corrected));
        for measured in self.events.iter_mut().filter_map(|event| event.measured.as_mut()) {
            measured.pose = corrected(&measured.pose);
            if let Some(rival) = &mut measured.rival {
                rival.pose = corrected(&rival.pose);
            }
        }
        self.refilter_from(0, ego);
    }

    pub(super) fn refilter_from(&mut self, first: usize, ego: &EgoRotation) {
        for later in first..self.events.len() {
            let before = self.belief_before(later).cloned();
            if let Some(event) = self.events.get_mut(later) {
                event.after = before;
                event.step(&self.policy, ego);
            }
        }
    }

    /// Forgets the neighbour, for example when the source starts anew.
    pub fn forget(&mut self) {
        self.base = None;
        self.events.clear();
    }

    /// What is believed from the frames up to a time.
    fn belief_at(&self, at_s: f64) -> Option<&Belief> {
        self.belief_before(self.events.partition_point(|event| event.stamp_s <= at_s))
    }

    fn belief(&self) -> Option<&Belief> {
        self.belief_before(self.events.len())
    }

    fn belief_before(&self, index: usize) -> Option<&Belief> {
        match index.checked_sub(1).and_then(|before| self.events.get(before)) {
            Some(event) => event.after.as_ref(),
            None => self.base.as_ref(),
        }
    }

    /// The newest event's time, if `stamp_s` lies before the history.
    fn too_late(&self, stamp_s: f64) -> Option<f64> {
        let newest_s = self.events.back()?.stamp_s;
        (stamp_s < newest_s - HISTORY_S).then_some(newest_s)
    }

    /// Whether a frame this late proves that the clock has jumped.
    fn is_jump(&self, late_s: f64) -> bool {
        late_s > self.policy.coast_s.max(HISTORY_S)
    }

    /// An event and its index, with the state before it.
    fn placed(&self, stamp_s: f64, measured: Option<FrameMeasurement>) -> (usize, HistoryEntry) {
        let mut event = HistoryEntry { stamp_s, measured, after: None };
        let place = self.events.partition_point(|other| other.is_before(&event));
        event.after = self.belief_before(place).cloned();
        (place, event)
    }

    /// Inserts an event, filters all later ones anew, and removes those that are too old.
    fn insert(&mut self, place: usize, event: HistoryEntry, ego: &EgoRotation) {
        let stamp_s = event.stamp_s;
        let is_measured = event.measured.is_some();
        self.events.insert(place, event);
        if is_measured {
            self.events.retain(|event| event.stamp_s != stamp_s || event.measured.is_some());
        }
        self.refilter_from(place + 1, ego);
        let newest_s = self.events.back().map_or(stamp_s, |newest| newest.stamp_s);
        while let Some(oldest) = self.events.front()
            && oldest.stamp_s < newest_s - HISTORY_S
        {
            self.base = self.events.pop_front().and_then(|oldest| oldest.after);
        }
    }
}

impl HistoryEntry {
    /// Events of one time have an order too, so that the order of arrival does not matter.
    fn is_before(&self, other: &Self) -> bool {
        let by_measurement = || match (&self.measured, &other.measured) {
            (Some(measured), Some(other)) => order(&measured.pose, &other.pose),
            // Events with a measurement come first.
            (measured, other) => other.is_some().cmp(&measured.is_some()),
        };
        self.stamp_s.total_cmp(&other.stamp_s).then_with(by_measurement).is_lt()
    }

    /// Advances the state in `after`. A refused measurement leaves it unchanged.
    fn step(&mut self, policy: &TrackPolicy, ego: &EgoRotation) {
        if let Some(measured) = &self.measured {
            let _ = Belief::measured(&mut self.after, self.stamp_s, measured, policy, ego);
        } else if let Some(belief) = &mut self.after {
            belief.unseen(self.stamp_s, policy);
        }
    }
}

/// An arbitrary but fixed order.
fn order(one: &PoseEstimate, other: &PoseEstimate) -> Ordering {
    let numbers = |measured: &PoseEstimate| -> Vec<f64> {
        let pose = &measured.camera_from_markers;
        let (at, turn) = (pose.translation.vector, pose.rotation.coords);
        at.iter().chain(turn.iter()).chain(measured.covariance.iter()).copied().collect()
    };
    numbers(one).partial_cmp(&numbers(other)).unwrap_or(Ordering::Equal)
}
