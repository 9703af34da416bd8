//! What is believed of a neighbour after a frame: the likeliest track, and rivals that may be the
//! right one instead.
//!
//! A frame may show two poses that explain it almost equally well, or one that contradicts the
//! track. Each is filtered as a hypothesis of its own (multiple hypothesis tracking: Blackman,
//! "Multiple Hypothesis Tracking for Multiple Target Tracking", 2004), until evidence decides.

use std::sync::LazyLock;

use serde::{Deserialize, Serialize};

use crate::ego_rotation::EgoRotation;
use crate::pose::{PoseEstimate, is_false, least_lead};

use super::life::{FrameMeasurement, Happened, RivalPose, TrackPolicy, TrackState};
use super::{FilterError, MotionEstimate, MotionModel, check, chi_square_gate};

/// Number of frames among which the confirming measurements are counted, at most 64.
pub const CONFIRM_WINDOW: u32 = 5;
/// Probability that a right measurement passes the gate.
pub const GATE_PROBABILITY: f64 = 0.999;
/// Number of frames in a row without an accepted measurement after which a track is stale: its
/// target may be anywhere, and a measurement that the picture alone proves replaces it.
pub const STALE_AFTER_FRAMES: u32 = 3;

/// The largest squared distance of a measurement that passes the gate.
static GATE: LazyLock<f64> = LazyLock::new(|| chi_square_gate(GATE_PROBABILITY));

/// Log odds against a track whose gate a measurement does not pass. A right track has such a
/// measurement with the probability that is left.
fn gate_lead() -> f64 {
    -(1.0 - GATE_PROBABILITY).ln()
}

/// Largest number of hypotheses: the two poses of a flat marker, and another place.
const HYPOTHESES: usize = 3;

/// Belief in one neighbour after a frame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Belief {
    pub(super) best: Hypothesis,
    /// The likeliest first.
    rivals: Vec<Rival>,
    state: TrackState,
}

/// One track that a neighbour may have.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Hypothesis {
    pub(super) track: MotionEstimate,
    /// One bit for each frame, the newest lowest: 1 for an accepted measurement.
    hits: u64,
    pub(super) started_s: f64,
}

/// A hypothesis that is less likely than the best one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Rival {
    hypothesis: Hypothesis,
    odds: Odds,
}

/// Log odds of the best hypothesis against its rival, or of a frame's first pose against a second.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
struct Odds {
    /// From the pictures. Frames in a row share their errors (blur, light, calibration), so the
    /// strongest of them counts, not their sum.
    picture: f64,
    /// From measurements that passed the gate of one hypothesis only.
    gate: f64,
}

impl Odds {
    fn lead(self) -> f64 {
        self.picture + self.gate
    }

    /// These odds after a frame whose picture gives `picture`.
    fn with_picture(self, picture: f64) -> Self {
        let is_stronger = picture.abs() > self.picture.abs();
        Self { picture: if is_stronger { picture } else { self.picture }, ..self }
    }

    fn less(self, other: Self) -> Self {
        Self { picture: self.picture - other.picture, gate: self.gate - other.gate }
    }
}

impl Rival {
    /// Whether the best hypothesis does not lead by enough to exclude this one.
    fn is_possible(&self) -> bool {
        self.odds.lead() < least_lead()
    }
}

impl Hypothesis {
    fn start(stamp_s: f64, pose: &PoseEstimate, motion: &MotionModel) -> Result<Self, FilterError> {
        let track = MotionEstimate::start(stamp_s, pose, motion)?;
        Ok(Self { track, hits: 1, started_s: stamp_s })
    }

    /// Counts a frame.
    fn count(&mut self, is_hit: bool) {
        self.hits = (self.hits << 1 | u64::from(is_hit)) & (u64::MAX >> (64 - CONFIRM_WINDOW));
    }

    fn is_hit(&self) -> bool {
        self.hits & 1 == 1
    }

    /// Whether the two hypotheses differ: one is false if the other is true, or the frame supports
    /// only one of them.
    fn differs_from(&self, other: &Self) -> bool {
        is_false(&self.track.camera_from_markers, &other.track.camera_from_markers)
            || self.is_hit() != other.is_hit()
    }

    fn check(&self) -> Result<(), FilterError> {
        let Self { track, started_s, .. } = self;
        check(track.stamp_s, &track.pose())?;
        let mut rest = track.velocity.iter().chain(&track.rate).chain(&track.covariance);
        if !started_s.is_finite() || !rest.all(|number| number.is_finite()) {
            return Err(FilterError::Unusable { what: "saved track" });
        }
        Ok(())
    }
}

impl Belief {
    /// Begins a track with its first measurement.
    fn begin(
        stamp_s: f64,
        measured: &FrameMeasurement,
        policy: &TrackPolicy,
    ) -> Result<Self, FilterError> {
        let start = |pose: &PoseEstimate| Hypothesis::start(stamp_s, pose, &policy.motion);
        let rival = |RivalPose { pose, lead }: &RivalPose| {
            let odds = Odds { picture: *lead, gate: 0.0 };
            Ok(Rival { hypothesis: start(pose)?, odds })
        };
        let best = start(&measured.pose)?;
        let rivals = measured.rival.iter().map(rival).collect::<Result<_, _>>()?;
        let state = Self::state_of(TrackState::Tentative, best.hits, policy);
        Ok(Self { best, rivals, state })
    }

    pub(super) fn state(&self) -> TrackState {
        self.state
    }

    /// Time of the best hypothesis's first measurement, seconds.
    pub(super) fn started_s(&self) -> f64 {
        self.best.started_s
    }

    /// Time of the best hypothesis's last accepted measurement, seconds.
    pub(super) fn last_seen_s(&self) -> f64 {
        self.best.track.stamp_s
    }

    /// The best hypothesis of a track that is not lost.
    pub(super) fn alive(&self) -> Option<&MotionEstimate> {
        (self.state != TrackState::Lost).then_some(&self.best.track)
    }

    pub(super) fn lose(&mut self) {
        self.state = TrackState::Lost;
    }

    pub(super) fn is_stale(&self) -> bool {
        self.best.hits.trailing_zeros() >= STALE_AFTER_FRAMES
    }

    /// The rival at a time, if the best hypothesis does not lead by enough to exclude it.
    pub(super) fn predict_rival(
        &self,
        at_s: f64,
        motion: &MotionModel,
        ego: &EgoRotation,
    ) -> Option<RivalPose> {
        let best = self.alive()?.predict(at_s, motion, ego).ok()?;
        let possible = self.rivals.iter().filter(|rival| rival.is_possible());
        let mut poses = possible.filter_map(|Rival { hypothesis, odds }| {
            let pose = hypothesis.track.predict(at_s, motion, ego).ok()?.pose();
            Some(RivalPose { pose, lead: odds.lead() })
        });
        poses.find(|RivalPose { pose, .. }| {
            is_false(&pose.camera_from_markers, &best.camera_from_markers)
        })
    }

    /// Handles a measurement at `stamp_s`.
    pub(super) fn measured(
        belief: &mut Option<Self>,
        stamp_s: f64,
        measured: &FrameMeasurement,
        policy: &TrackPolicy,
        ego: &EgoRotation,
    ) -> Result<Happened, FilterError> {
        let fresh = Self::begin(stamp_s, measured, policy)?;
        let follows = |belief: &Self| stamp_s - belief.last_seen_s() <= policy.coast_s;
        let known = belief.as_mut().filter(|known| known.alive().is_some() && follows(known));
        let Some(known) = known else {
            *belief = Some(fresh);
            return Ok(Happened::Started);
        };
        let Some(mut updated) = known.updated(stamp_s, measured, policy, ego)? else {
            *known = fresh;
            return Ok(Happened::Restarted);
        };
        if !updated.iter().any(|(_, one)| one.hypothesis.is_hit()) {
            if known.state == TrackState::Tentative || (measured.is_proven && known.is_stale()) {
                *known = fresh;
                return Ok(Happened::Restarted);
            }
            // The measurement contradicts all that is known: it may be false, or the track.
            let odds = Odds { picture: 0.0, gate: 2.0 * gate_lead() };
            updated.push((HYPOTHESES, Rival { hypothesis: fresh.best, odds }));
        }
        updated.sort_by(|(_, one), (_, other)| one.odds.lead().total_cmp(&other.odds.lead()));
        let mut kept: Vec<Rival> = Vec::new();
        let mut best_before = 0;
        for (before, Rival { hypothesis, odds }) in updated {
            let best = kept.first().map_or(odds, |best| best.odds);
            let is_likely = odds.less(best).lead() <= gate_lead() + 1e-9;
            let is_new = kept.iter().all(|other| hypothesis.differs_from(&other.hypothesis));
            if kept.is_empty() {
                best_before = before;
            }
            if is_likely && is_new && kept.len() < HYPOTHESES {
                kept.push(Rival { hypothesis, odds });
            }
        }
        let mut kept = kept.into_iter();
        // There is one result at least for each hypothesis before.
        let Some(Rival { hypothesis: best, odds }) = kept.next() else {
            return Ok(Happened::Gated);
        };
        let is_replaced = best_before > 0;
        let before = if is_replaced { TrackState::Tentative } else { known.state };
        let is_hit = best.is_hit();
        known.state = Self::state_of(before, best.hits, policy);
        known.best = best;
        known.rivals = kept.map(|rival| Rival { odds: rival.odds.less(odds), ..rival }).collect();
        Ok(match (is_replaced, is_hit) {
            (true, _) => Happened::Restarted,
            (false, true) => Happened::Updated,
            (false, false) => Happened::Gated,
        })
    }

    /// Each hypothesis, by its place among those before the frame, with each pose of a measurement
    /// that passes its gate, and as unseen where none does. The odds are against the best one
    /// before. `None` if that is too old for an update.
    fn updated(
        &self,
        stamp_s: f64,
        measured: &FrameMeasurement,
        policy: &TrackPolicy,
        ego: &EgoRotation,
    ) -> Result<Option<Vec<(usize, Rival)>>, FilterError> {
        let rivals = self.rivals.iter().map(|rival| (&rival.hypothesis, rival.odds));
        let hypotheses = [(&self.best, Odds::default())].into_iter().chain(rivals);
        let second = measured.rival.as_ref().map(|rival| (&rival.pose, rival.lead));
        let mut updated = Vec::new();
        for (before, (known, odds)) in hypotheses.enumerate() {
            let mut is_matched = false;
            for (pose, picture) in [(&measured.pose, 0.0)].into_iter().chain(second) {
                let mut hypothesis = known.clone();
                match hypothesis.track.update(stamp_s, pose, *GATE, &policy.motion, ego) {
                    Ok(_) => {
                        is_matched = true;
                        hypothesis.count(true);
                        let odds = odds.with_picture(picture);
                        updated.push((before, Rival { hypothesis, odds }));
                    }
                    Err(FilterError::Gated { .. }) => {}
                    Err(FilterError::Gap { .. }) if before == 0 => return Ok(None),
                    Err(FilterError::Gap { .. }) => {}
                    Err(error) => return Err(error),
                }
            }
            if !is_matched {
                let mut hypothesis = known.clone();
                hypothesis.count(false);
                let odds = Odds { gate: odds.gate + gate_lead(), ..odds };
                updated.push((before, Rival { hypothesis, odds }));
            }
        }
        Ok(Some(updated))
    }

    /// Handles a frame without a measurement.
    pub(super) fn unseen(&mut self, stamp_s: f64, policy: &TrackPolicy) {
        if stamp_s - self.last_seen_s() > policy.coast_s {
            self.lose();
            return;
        }
        self.best.count(false);
        self.rivals.iter_mut().for_each(|rival| rival.hypothesis.count(false));
        self.state = Self::state_of(self.state, self.best.hits, policy);
    }

    /// The state of a track after a frame, with the state before it.
    fn state_of(before: TrackState, hits: u64, policy: &TrackPolicy) -> TrackState {
        let is_hit = hits & 1 == 1;
        match (before, hits.count_ones()) {
            (TrackState::Lost, _) | (TrackState::Tentative, 0) => TrackState::Lost,
            (TrackState::Tentative, hits) if hits < policy.confirm_hits.min(CONFIRM_WINDOW) => {
                TrackState::Tentative
            }
            _ if is_hit => TrackState::Confirmed,
            _ => TrackState::Coasting,
        }
    }

    /// Checks a belief of another process.
    ///
    /// # Errors
    /// [`FilterError::Unusable`].
    pub(super) fn check(&self) -> Result<(), FilterError> {
        self.best.check()?;
        self.rivals.iter().try_for_each(|Rival { hypothesis, odds }| match odds.lead().is_nan() {
            true => Err(FilterError::Unusable { what: "lead" }),
            false => hypothesis.check(),
        })
    }
}
