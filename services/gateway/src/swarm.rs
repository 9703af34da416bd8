//! Where all drones are from here: messages and reports to the estimator, and its poses back.

use flockeye_contract::{FrameStamp, PeerSighting, Rotation, SwarmPose, Track};
use flockeye_convert::{camera_turn, pose, row_major};
use flockeye_peer::{PeerReport, Place, SwarmView};
use nalgebra::UnitQuaternion;

/// What this drone knows of the swarm.
#[derive(Debug)]
pub(crate) struct Swarm {
    observer_from_camera: UnitQuaternion<f64>,
    view: SwarmView,
}

impl Swarm {
    /// The swarm as the drone `own` has it, whose camera is mounted so.
    pub(crate) fn new(own: &str, observer_from_camera: UnitQuaternion<f64>) -> Self {
        Self { observer_from_camera, view: SwarmView::from(own) }
    }

    /// This drone has turned.
    pub(crate) fn turned(&mut self, message: &Rotation) {
        if let Some(turn) = camera_turn(message) {
            self.view.turned(&turn.in_frame(&self.observer_from_camera));
        }
    }

    /// This drone sees somebody, at an exposure on CLOCK_MONOTONIC.
    pub(crate) fn sees(&mut self, stamp: &FrameStamp, exposure_monotonic_ns: i64, track: &Track) {
        let own = self.view.own();
        if let Some(report) = PeerReport::of_track(own, stamp, exposure_monotonic_ns, track) {
            self.view.hear(&report);
        }
    }

    /// A peer sees somebody.
    pub(crate) fn hears(&mut self, report: &PeerReport) {
        self.view.hear(report);
    }

    /// Where all are at `at_ns`, CLOCK_MONOTONIC.
    pub(crate) fn poses(&mut self, at_ns: i64) -> Vec<SwarmPose> {
        self.view.places(at_ns).iter().map(swarm_pose).collect()
    }

    /// The observers whose reports contradict the others'.
    pub(crate) fn left_out(&self) -> Vec<String> {
        self.view.left_out()
    }

    /// A peer's report as the topic `peer` has it.
    pub(crate) fn peer_sighting(&self, report: &PeerReport) -> PeerSighting {
        let seen = report.observer_from_target;
        let inverse = report.target_from_observer();
        PeerSighting {
            observer_from_target: pose(&seen.a_from_b),
            covariance: row_major(&seen.covariance),
            target_from_observer: pose(&inverse.a_from_b),
            inverse_covariance: row_major(&inverse.covariance),
            linear_velocity: report.velocity.into(),
            angular_velocity: report.rate.into(),
            exposure_ns: report.exposure_monotonic_ns,
            exposure_deviation_ns: report.exposure_deviation_ns,
            frame: report.frame.1,
            observer: report.observer.as_str().into(),
            target: report.target.as_str().into(),
            epoch: report.frame.0,
            state: report.state.code(),
            measured_by: report.measured_by.code(),
            is_own: u32::from(report.target == self.view.own()),
        }
    }
}

fn swarm_pose(place: &Place) -> SwarmPose {
    SwarmPose {
        own_from_drone: pose(&place.own_from_drone.a_from_b),
        covariance: row_major(&place.own_from_drone.covariance),
        seen_ns: (place.seen_s * 1e9) as i64,
        name: place.name.as_str().into(),
        through: place.through.as_deref().unwrap_or_default().into(),
        way: place.way.code(),
        pairs: place.pairs as u32,
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use flockeye_contract::{Peers, Pose, SwarmWay, Swarms, Topic, TrackState};

    use super::*;
    use crate::frame::tests::{frame_report, track};

    const NOW_NS: i64 = 100_000_000_000;

    fn small() -> [f64; 36] {
        let mut covariance = [0.0; 36];
        (0..6).for_each(|k| covariance[7 * k] = 1e-5);
        covariance
    }

    fn seen(position: [f64; 3]) -> Track {
        let at = Pose { position, ..Pose::default() };
        Track {
            observer_from_target: at,
            measured_observer_from_target: at,
            covariance: small(),
            measured_covariance: small(),
            ..track(TrackState::Confirmed)
        }
    }

    fn heard(observer: &str, target: &str, position: [f64; 3]) -> PeerReport {
        let report = frame_report(observer, Track { name: target.into(), ..seen(position) });
        PeerReport::from(&flockeye_network::TimedSighting {
            arrived_monotonic_ns: NOW_NS,
            exposure_monotonic_ns: NOW_NS,
            exposure_deviation_ns: 100_000,
            report: report.sightings().next().unwrap(),
        })
    }

    #[test]
    fn a_neighbour_of_a_neighbour_is_found_through_it() {
        let mut swarm = Swarm::new("own", UnitQuaternion::identity());
        let stamp = FrameStamp::default();
        swarm.sees(&stamp, NOW_NS, &seen([1.0, 0.0, 0.0]));
        swarm.hears(&heard("kite", "swift", [0.0, 2.0, 0.0]));
        swarm.hears(&heard("kite", "own", [-1.0, 0.0, 0.0]));
        let poses = swarm.poses(NOW_NS);
        assert_eq!(Swarms::check(&Default::default(), &poses), Ok(()));
        let of = |name: &str| poses.iter().find(|pose| pose.name.to_string() == name).unwrap();
        assert_eq!(of("kite").way, SwarmWay::Mutual.code());
        let swift = of("swift");
        assert_eq!(
            (swift.way, swift.through.to_string().as_str()),
            (SwarmWay::Chained.code(), "kite")
        );
        let [x, y, _] = swift.own_from_drone.position;
        assert!((x - 1.0).abs() < 1e-3 && (y - 2.0).abs() < 1e-3, "{x} {y}");
        assert!(swift.covariance[0] > of("kite").covariance[0]);
        swarm.sees(
            &stamp,
            NOW_NS,
            &Track { state: TrackState::Lost.code(), ..seen([1.0, 0.0, 0.0]) },
        );
        assert_eq!(swarm.poses(NOW_NS)[0].way, SwarmWay::Reported.code());
    }

    #[test]
    fn what_a_peer_says_of_this_drone_is_said_the_other_way_round_too() {
        let swarm = Swarm::new("own", UnitQuaternion::identity());
        let sighting = swarm.peer_sighting(&heard("wren", "own", [1.0, 0.0, 0.5]));
        assert_eq!(Peers::check(&Default::default(), &[sighting]), Ok(()));
        assert_eq!(
            (sighting.is_own, sighting.target_from_observer.position),
            (1, [-1.0, 0.0, -0.5])
        );
        // A tilt of the observer moves it sideways as its target sees it.
        assert!(sighting.inverse_covariance[7] > sighting.covariance[7]);
    }
}
