//! Where all drones are, as one of them would have it.

use flockeye_contract::TrackState;
use flockeye_geometry::ego_rotation::{CameraTurn, EgoRotation};
use flockeye_network::monotonic_now_ns;

use crate::report::PeerReport;
use crate::swarm::{Observation, Place, SwarmEstimator, SwarmModel};

/// How long a drone's own rotation is kept, seconds: longer than reports are under way.
const ROTATION_KEPT_S: f64 = 2.0;

/// Combines reports into where all drones are from one of them.
#[derive(Debug)]
pub struct SwarmView {
    own: String,
    ego: EgoRotation,
    estimator: SwarmEstimator,
}

impl SwarmView {
    /// A view from the drone `own`: its frame is the origin, and its sightings are believed before others'.
    pub fn from(own: &str) -> Self {
        Self {
            own: own.to_owned(),
            ego: EgoRotation::new(ROTATION_KEPT_S),
            estimator: SwarmEstimator::new(own, SwarmModel::default()),
        }
    }

    /// The drone whose frame is the origin.
    pub fn own(&self) -> &str {
        &self.own
    }

    /// Takes in how the origin has turned, in its own frame. Without it poses rest on wider assumptions.
    pub fn turned(&mut self, turn: &CameraTurn) {
        self.ego.add(turn);
    }

    /// Takes in a report, of the origin's own or of a peer's sighting.
    pub fn hear(&mut self, report: &PeerReport) {
        match report.state {
            TrackState::Lost => self.estimator.lose(&report.observer, &report.target),
            TrackState::Tentative => {}
            TrackState::Confirmed | TrackState::Coasting | TrackState::Measured => {
                let seen = Observation {
                    observer: &report.observer,
                    target: &report.target,
                    at_s: report.exposure_monotonic_ns as f64 * 1e-9,
                    deviation_s: report.exposure_deviation_ns as f64 * 1e-9,
                    filtered: report.observer_from_target,
                    velocity: report.velocity,
                    rate: report.rate,
                    measured: report.measured,
                };
                self.estimator.see(&seen, &self.ego);
            }
        }
    }

    /// Poses of all drones at an instant of this machine's CLOCK_MONOTONIC, nanoseconds.
    pub fn places(&mut self, at_monotonic_ns: i64) -> Vec<Place> {
        self.estimator.places(at_monotonic_ns as f64 * 1e-9, &self.ego)
    }

    /// Poses of all drones now.
    pub fn places_now(&mut self) -> Vec<Place> {
        self.places(monotonic_now_ns())
    }

    /// The observers whose reports contradict the others', and are left out.
    pub fn left_out(&self) -> Vec<String> {
        self.estimator.left_out().map(str::to_owned).collect()
    }
}
