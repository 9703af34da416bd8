//! What is believed of a neighbour after a frame: the likeliest track, and rivals that may be the
//! right one instead.
//!
//! A frame may show two poses that explain it almost equally well, or one that contradicts the
//! track. Each is filtered as a branch of its own (multiple hypothesis tracking: Blackman,
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

/// Largest number of branches: the two poses of a flat marker, and another place.
const BRANCHES: usize = 3;

/// Belief in one neighbour after a frame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Belief {
    pub(super) best: Branch,
    /// The likeliest first.
    pub(super) rivals: Vec<Rival>,
    state: TrackState,
}

/// One track that a neighbour may have.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Branch {
    pub(super) track: MotionEstimate,
    /// One bit for each frame, the newest lowest: 1 for an accepted measurement.
    hits: u64,
    pub(super) started_s: f64,
}

/// A branch that is less likely than the best one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Rival {
    pub(super) branch: Branch,
    pub(super) odds: Odds,
}

/// A branch after a frame, with its place before: 0 for the best one, `None` for a new one.
type Updated = (Option<usize>, Rival);

/// Log odds of the best branch against a rival.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub(super) struct Odds {
    /// From what single frames said of both. Frames in a row share their errors (blur, light,
    /// calibration), so the strongest of them counts, not their sum.
    pub(super) frame: f64,
    /// From measurements that passed the gate of one branch only.
    gate: f64,
}

impl Odds {
    fn lead(self) -> f64 {
        self.frame + self.gate
    }

    /// These odds after a frame that says `frame` of the same two.
    fn after(self, frame: f64) -> Self {
        let is_stronger = frame.abs() > self.frame.abs();
        Self { frame: if is_stronger { frame } else { self.frame }, ..self }
    }

    fn less(self, other: Self) -> Self {
        Self { frame: self.frame - other.frame, gate: self.gate - other.gate }
    }
}

impl Rival {
    /// Whether the best branch does not lead by enough to exclude this one.
    fn is_possible(&self) -> bool {
        self.odds.lead() < least_lead()
    }
}

impl Branch {
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

    /// Whether the two branches differ: one is false if the other is true, or the frame supports
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
    /// Moves all branches to the corrected poses. Their covariances stay.
    pub(super) fn correct(&mut self, corrected: &impl Fn(&PoseEstimate) -> PoseEstimate) {
        let rivals = self.rivals.iter_mut().map(|rival| &mut rival.branch);
        for Branch { track, .. } in rivals.chain([&mut self.best]) {
            track.camera_from_markers = corrected(&track.pose()).camera_from_markers;
        }
    }

    /// Begins a track with its first measurement.
    fn begin(
        stamp_s: f64,
        measured: &FrameMeasurement,
        policy: &TrackPolicy,
    ) -> Result<Self, FilterError> {
        let start = |pose: &PoseEstimate| Branch::start(stamp_s, pose, &policy.motion);
        let rival = |RivalPose { pose, lead }: &RivalPose| {
            let odds = Odds { frame: *lead, gate: 0.0 };
            Ok(Rival { branch: start(pose)?, odds })
        };
        let best = start(&measured.pose)?;
        let rivals = measured.rival.iter().map(rival).collect::<Result<_, _>>()?;
        let state = Self::state_of(TrackState::Tentative, best.hits, policy);
        Ok(Self { best, rivals, state })
    }

    pub(super) fn state(&self) -> TrackState {
        self.state
    }

    /// Time of the best branch's first measurement, seconds.
    pub(super) fn started_s(&self) -> f64 {
        self.best.started_s
    }

    /// Time of the best branch's last accepted measurement, seconds.
    pub(super) fn last_seen_s(&self) -> f64 {
        self.best.track.stamp_s
    }

    /// The best branch of a track that is not lost.
    pub(super) fn alive(&self) -> Option<&MotionEstimate> {
        (self.state != TrackState::Lost).then_some(&self.best.track)
    }

    pub(super) fn lose(&mut self) {
        self.state = TrackState::Lost;
    }

    pub(super) fn is_stale(&self) -> bool {
        self.best.hits.trailing_zeros() >= STALE_AFTER_FRAMES
    }

    /// The rival at a time, if the best branch does not lead by enough to exclude it.
    pub(super) fn predict_rival(
        &self,
        at_s: f64,
        motion: &MotionModel,
        ego: &EgoRotation,
    ) -> Option<RivalPose> {
        let best = self.alive()?.predict(at_s, motion, ego).ok()?;
        let possible = self.rivals.iter().filter(|rival| rival.is_possible());
        let mut poses = possible.filter_map(|Rival { branch, odds }| {
            let pose = branch.track.predict(at_s, motion, ego).ok()?.pose();
            Some(RivalPose { pose, lead: odds.lead() })
        });
        poses.find(|RivalPose { pose, .. }| {
            is_false(&pose.camera_from_markers, &best.camera_from_markers)
        })
    }

    /// Handles a measurement at `stamp_s`. Returns its effect, and whether it passes the gate of the
    /// best branch or of a possible rival.
    pub(super) fn measured(
        belief: &mut Option<Self>,
        stamp_s: f64,
        measured: &FrameMeasurement,
        policy: &TrackPolicy,
        ego: &EgoRotation,
    ) -> Result<(Happened, bool), FilterError> {
        let fresh = Self::begin(stamp_s, measured, policy)?;
        let follows = |belief: &Self| stamp_s - belief.last_seen_s() <= policy.coast_s;
        let known = belief.as_mut().filter(|known| known.alive().is_some() && follows(known));
        let Some(known) = known else {
            *belief = Some(fresh);
            return Ok((Happened::Started, false));
        };
        let Some(mut updated) = known.updated(stamp_s, measured, policy, ego)? else {
            *known = fresh;
            return Ok((Happened::Restarted, false));
        };
        let is_hit = |(_, one): &Updated| one.branch.is_hit();
        let fits_any = updated.iter().any(is_hit);
        let fits_best = updated.iter().any(|one| one.0 == Some(0) && is_hit(one));
        let possible = 1 + known.rivals.iter().take_while(|rival| rival.is_possible()).count();
        let fits =
            updated.iter().any(|one| one.0.is_some_and(|before| before < possible) && is_hit(one));
        let is_tentative = known.state == TrackState::Tentative;
        let replaces_stale = measured.is_proven && known.is_stale();
        if (!fits_any && is_tentative) || (!fits_best && replaces_stale) {
            *known = fresh;
            return Ok((Happened::Restarted, fits));
        }
        if !fits_any {
            // The measurement contradicts all that is known: it may be false, or the track. All
            // branches have lost `gate_lead` in this frame already.
            let behind = |odds: Odds| Odds { gate: odds.gate + 2.0 * gate_lead(), ..odds };
            let best = Rival { branch: fresh.best, odds: Odds::default() };
            let new = [best].into_iter().chain(fresh.rivals);
            updated.extend(
                new.map(|Rival { branch, odds }| (None, Rival { branch, odds: behind(odds) })),
            );
        }
        let is_replaced = known.keep_likeliest(updated, policy);
        let happened = match (is_replaced, known.best.is_hit()) {
            (true, _) => Happened::Restarted,
            (false, true) => Happened::Updated,
            (false, false) => Happened::Gated,
        };
        Ok((happened, fits))
    }

    /// Keeps the likeliest of the branches after a frame, at most [`BRANCHES`], and the state that
    /// follows. Returns whether another one is the best now.
    fn keep_likeliest(&mut self, mut updated: Vec<Updated>, policy: &TrackPolicy) -> bool {
        updated.sort_by(|(_, one), (_, other)| one.odds.lead().total_cmp(&other.odds.lead()));
        let mut updated = updated.into_iter();
        // There is one result at least for each branch before.
        let Some((before, Rival { branch: best, odds })) = updated.next() else { return false };
        let mut rivals: Vec<Rival> = Vec::new();
        for (_, Rival { branch, odds: against }) in updated {
            let odds = against.less(odds);
            let known = [&best].into_iter().chain(rivals.iter().map(|rival| &rival.branch));
            let is_new = known.into_iter().all(|other| branch.differs_from(other));
            if is_new && odds.gate <= gate_lead() + 1e-9 && rivals.len() + 1 < BRANCHES {
                rivals.push(Rival { branch, odds });
            }
        }
        let is_replaced = before != Some(0);
        let state = if is_replaced { TrackState::Tentative } else { self.state };
        let state = Self::state_of(state, best.hits, policy);
        *self = Self { best, rivals, state };
        is_replaced
    }

    /// Each branch, updated with each pose of a measurement that passes its gate. A branch whose gate
    /// none passes is unseen. The odds are those of the branch that was the best. `None` if that is
    /// too old for an update.
    fn updated(
        &self,
        stamp_s: f64,
        measured: &FrameMeasurement,
        policy: &TrackPolicy,
        ego: &EgoRotation,
    ) -> Result<Option<Vec<Updated>>, FilterError> {
        let rivals = self.rivals.iter().map(|rival| (&rival.branch, rival.odds));
        let branches = [(&self.best, Odds::default())].into_iter().chain(rivals);
        let second = measured.rival.as_ref().map(|rival| (&rival.pose, rival.lead));
        let mut updated = Vec::new();
        // What the frame says of the pose that the best branch has there.
        let mut of_best = None;
        for (before, (known, odds)) in branches.enumerate() {
            let mut is_matched = false;
            for (pose, behind) in [(&measured.pose, 0.0)].into_iter().chain(second) {
                let mut branch = known.clone();
                if let Some(jump) = &measured.jump {
                    branch.track.loosen(jump);
                }
                match branch.track.update(stamp_s, pose, *GATE, &policy.motion, ego) {
                    Ok(_) => {
                        is_matched = true;
                        branch.count(true);
                        if before == 0 {
                            of_best.get_or_insert(behind);
                        }
                        let odds = of_best.map_or(odds, |of_best| odds.after(behind - of_best));
                        updated.push((Some(before), Rival { branch, odds }));
                    }
                    Err(FilterError::Gated { .. }) => {}
                    Err(FilterError::Gap { .. }) if before == 0 => return Ok(None),
                    Err(FilterError::Gap { .. }) => {}
                    Err(error) => return Err(error),
                }
            }
            if !is_matched {
                let mut branch = known.clone();
                branch.count(false);
                let odds = Odds { gate: odds.gate + gate_lead(), ..odds };
                updated.push((Some(before), Rival { branch, odds }));
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
        self.rivals.iter_mut().for_each(|rival| rival.branch.count(false));
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
        self.rivals.iter().try_for_each(|Rival { branch, odds }| match odds.lead().is_finite() {
            false => Err(FilterError::Unusable { what: "lead" }),
            true => branch.check(),
        })
    }
}
