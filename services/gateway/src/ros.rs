//! What ROS 2 nodes are told.

use flockeye_config::Ros2;
use flockeye_contract::wire::{Sighting, TargetReport};
use flockeye_contract::{Track, TrackState};
use flockeye_network::Heard;
use flockeye_peer::PeerReport;
use flockeye_ros2::{
    NeighbourPose, ObserverSeen, RelativePose, Ros2Error, Ros2Mode, Ros2Node, Ros2Parameters,
    Velocity,
};
use flockeye_runtime::logs::Throttle;

/// A node of ROS 2, and how often it refused something.
#[derive(Debug)]
pub struct Ros {
    node: Ros2Node,
    failures: Throttle,
}

impl Ros {
    /// The node of the drone `observer`. It looks for its router in the background.
    ///
    /// # Errors
    /// A setting that cannot work.
    pub fn open(settings: &Ros2, observer: &str) -> Result<Self, Ros2Error> {
        let parameters = Ros2Parameters {
            domain: settings.domain,
            mode: Ros2Mode::Client,
            connect: settings.connect.clone(),
            namespace: settings.namespace.clone(),
            ..Ros2Parameters::default()
        };
        let node = Ros2Node::open(&parameters, observer)?;
        Ok(Self { node, failures: Throttle::default() })
    }

    /// This drone sees neighbours, in a frame of this time.
    pub fn sees(&mut self, stamp_utc_ns: i64, tracks: &[Track]) {
        let seen = tracks.iter().filter(|track| is_told(track));
        let neighbours: Vec<NeighbourPose> = seen
            .map(|track| NeighbourPose {
                target: track.name.to_string(),
                pose: RelativePose {
                    stamp_utc_ns,
                    position: track.observer_from_target.position,
                    orientation: track.observer_from_target.orientation,
                    covariance: track.covariance,
                },
            })
            .collect();
        for neighbour in &neighbours {
            let told = self.node.publish_neighbour(neighbour);
            self.log(told);
        }
        if !neighbours.is_empty() {
            let told = self.node.publish_transforms(&neighbours);
            self.log(told);
        }
    }

    /// A peer sees this drone.
    pub fn is_seen(&mut self, heard: &Heard, report: &PeerReport) {
        let Sighting { stamp_utc_ns, target, .. } = &heard.report;
        let TargetReport { position, orientation, linear_velocity, angular_velocity, .. } = target;
        if target.state == TrackState::Lost {
            return;
        }
        let covariance = report.observer_from_target.covariance;
        let seen = ObserverSeen {
            peer: heard.report.observer.clone(),
            pose: RelativePose {
                stamp_utc_ns: *stamp_utc_ns,
                position: *position,
                orientation: *orientation,
                covariance: flockeye_convert::row_major(&covariance),
            },
            velocity: Some(Velocity { linear: *linear_velocity, angular: *angular_velocity }),
        };
        let told = self.node.publish_odometry(&seen);
        self.log(told);
    }

    fn log(&mut self, told: Result<(), Ros2Error>) {
        if let Err(error) = told
            && let Some(more_since) = self.failures.admit()
        {
            tracing::warn!(more_since, "ROS 2 is not told: {error}");
        }
    }
}

/// Not of tracks that may be nobody, and not of those that are lost.
fn is_told(track: &Track) -> bool {
    let state = TrackState::try_from(track.state);
    matches!(state, Ok(TrackState::Confirmed | TrackState::Coasting | TrackState::Measured))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::tests::track;

    #[test]
    fn who_may_be_nobody_or_is_lost_is_not_told_of() {
        let told = TrackState::ALL.iter().filter(|&&state| is_told(&track(state)));
        let told: Vec<_> = told.copied().collect();
        assert_eq!(told, [TrackState::Confirmed, TrackState::Coasting, TrackState::Measured]);
    }

    #[test]
    fn a_setting_that_cannot_work_is_refused_with_its_cure() {
        let settings = Ros2 { connect: vec!["7447".into()], ..Ros2::default() };
        let error = Ros::open(&settings, "wren").map(drop).map_err(|error| error.to_string());
        assert!(error.is_err_and(|error| error.contains("connect[0]")));
    }
}
