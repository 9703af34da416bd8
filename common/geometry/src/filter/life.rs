//! The life of a track: when a neighbour is believed, and when it is given up.

use nalgebra::{Isometry3, Matrix6};

use super::{FilterError, Innovation, MotionModel, Prediction, Track, chi_square_gate};

/// Where a track is in its life.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TrackState {
    /// Seen too few times to be believed.
    Tentative,
    /// Believed, and measured in the last frame.
    Confirmed,
    /// Believed, but not measured in the last frame.
    Coasting,
    /// Not seen for too long.
    Lost,
}

/// When a track is believed and when it is given up.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackPolicy {
    /// How the neighbour is thought to move.
    pub motion: MotionModel,
    /// Measurements taken in that confirm a track, the first included...
    pub confirm_hits: u32,
    /// ...among so many frames, at most 64.
    pub confirm_window: u32,
    /// A confirmed track is lost when it was not seen for longer than this, seconds.
    pub coast_s: f64,
    /// Probability that a right measurement passes the gate.
    pub gate_probability: f64,
    /// So many measurements in a row outside the gate mean that the track is wrong: it begins anew
    /// from the last of them. A tentative track does with the first.
    pub restart_after_gated: u32,
}

impl Default for TrackPolicy {
    /// Confirmed by 3 hits in 5 frames, coasting for 1 s, 0.1 % of right measurements gated.
    fn default() -> Self {
        Self {
            motion: MotionModel::default(),
            confirm_hits: 3,
            confirm_window: 5,
            coast_s: 1.0,
            gate_probability: 0.999,
            restart_after_gated: 3,
        }
    }
}

/// What became of a measurement.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Happened {
    /// It began a track where there was none, or a lost one.
    Started,
    /// It was taken in.
    Updated(Innovation),
    /// It lay outside the gate and counts as not seen.
    Gated(Innovation),
    /// It contradicted the track, or the clock jumped back: the track began anew from it.
    Restarted,
}

/// The track of one neighbour and its state. Call [`LifeCycle::measured`] or
/// [`LifeCycle::unseen`] once for each frame.
#[derive(Debug, Clone, PartialEq)]
pub struct LifeCycle {
    policy: TrackPolicy,
    gate: f64,
    life: Option<Life>,
}

#[derive(Debug, Clone, PartialEq)]
struct Life {
    track: Track,
    state: TrackState,
    /// One bit for each frame, the newest lowest: 1 where a measurement was taken in.
    hits: u64,
    gated_in_a_row: u32,
    started_s: f64,
}

impl LifeCycle {
    /// Nothing was seen of the neighbour yet.
    pub fn new(policy: TrackPolicy) -> Self {
        Self { policy, gate: chi_square_gate(policy.gate_probability), life: None }
    }

    /// Where the track is in its life; `None` before the first measurement.
    pub fn state(&self) -> Option<TrackState> {
        self.life.as_ref().map(|life| life.state)
    }

    /// The filter, while the track is alive.
    pub fn track(&self) -> Option<&Track> {
        self.life.as_ref().filter(|life| life.state != TrackState::Lost).map(|life| &life.track)
    }

    /// When the track's first measurement was exposed, seconds.
    pub fn started_s(&self) -> Option<f64> {
        self.life.as_ref().map(|life| life.started_s)
    }

    /// When its last measurement taken in was exposed, seconds; also of a lost track.
    pub fn last_seen_s(&self) -> Option<f64> {
        self.life.as_ref().map(|life| life.track.stamp_s())
    }

    /// Where the neighbour will be at `at_s`; `None` while there is no live track, or if the filter
    /// knows nothing of that time.
    pub fn predict(&self, at_s: f64) -> Option<Prediction> {
        self.track()?.predict(at_s).ok()
    }

    /// A frame exposed at `stamp_s` in which the neighbour's pose was measured; `covariance` as in
    /// [`Track::update`].
    ///
    /// A frame from before the last measurement is refused, unless it is from so long before
    /// (`coast_s`) that the clock itself must have jumped: then the track begins anew.
    ///
    /// # Errors
    /// An unusable measurement ([`FilterError::Unusable`]) or one from the past
    /// ([`FilterError::Past`]); nothing changes then.
    pub fn measured(
        &mut self,
        stamp_s: f64,
        observer_from_target: &Isometry3<f64>,
        covariance: &Matrix6<f64>,
    ) -> Result<Happened, FilterError> {
        let fresh = Track::start(stamp_s, *observer_from_target, covariance, self.policy.motion)?;
        let policy = self.policy;
        let Some(life) = self.life.as_mut().filter(|life| life.state != TrackState::Lost) else {
            self.life = Some(Life::begin(fresh, &policy));
            return Ok(Happened::Started);
        };
        if stamp_s - life.track.stamp_s() > policy.coast_s {
            *life = Life::begin(fresh, &policy);
            return Ok(Happened::Started);
        }
        match life.track.update(stamp_s, observer_from_target, covariance, self.gate) {
            Ok(innovation) => {
                life.gated_in_a_row = 0;
                life.count(true, &policy);
                Ok(Happened::Updated(innovation))
            }
            Err(FilterError::Gated { innovation, .. }) => {
                life.gated_in_a_row += 1;
                if life.state == TrackState::Tentative
                    || life.gated_in_a_row >= policy.restart_after_gated
                {
                    *life = Life::begin(fresh, &policy);
                    return Ok(Happened::Restarted);
                }
                life.count(false, &policy);
                Ok(Happened::Gated(innovation))
            }
            Err(FilterError::Past { at_s, stamp_s }) if stamp_s - at_s <= policy.coast_s => {
                Err(FilterError::Past { at_s, stamp_s })
            }
            Err(FilterError::Past { .. } | FilterError::Gap { .. }) => {
                *life = Life::begin(fresh, &policy);
                Ok(Happened::Restarted)
            }
            Err(unusable @ FilterError::Unusable { .. }) => Err(unusable),
        }
    }

    /// A frame exposed at `stamp_s` in which nothing was measured of the neighbour although all
    /// that was to be searched was. Returns the state after it.
    pub fn unseen(&mut self, stamp_s: f64) -> Option<TrackState> {
        let policy = self.policy;
        let life = self.life.as_mut()?;
        if life.state != TrackState::Lost {
            // Either way round: a clock that jumped back leaves a track that means nothing.
            let unseen_s = (stamp_s - life.track.stamp_s()).abs();
            if unseen_s <= policy.coast_s {
                life.count(false, &policy);
            } else {
                life.state = TrackState::Lost;
            }
        }
        Some(life.state)
    }

    /// Forgets the neighbour, as when the source begins anew.
    pub fn forget(&mut self) {
        self.life = None;
    }
}

impl Life {
    fn begin(track: Track, policy: &TrackPolicy) -> Self {
        let started_s = track.stamp_s();
        let state = TrackState::Tentative;
        let mut life = Self { track, state, hits: 0, gated_in_a_row: 0, started_s };
        life.count(true, policy);
        life
    }

    /// Counts a frame and moves the state on.
    fn count(&mut self, hit: bool, policy: &TrackPolicy) {
        let window = policy.confirm_window.clamp(1, 64);
        self.hits = (self.hits << 1 | u64::from(hit)) & (u64::MAX >> (64 - window));
        let hits = self.hits.count_ones();
        self.state = match self.state {
            TrackState::Lost => TrackState::Lost,
            TrackState::Tentative if hits == 0 => TrackState::Lost,
            TrackState::Tentative if hits < policy.confirm_hits.min(window) => {
                TrackState::Tentative
            }
            _ if hit => TrackState::Confirmed,
            _ => TrackState::Coasting,
        };
    }
}
