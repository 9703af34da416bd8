//! Conversion of poses and sightings to the topics' formats.

use flockeye_contract::{PeerSighting, SwarmPose};
use flockeye_convert::{pose, row_major};
use flockeye_peer::{DronePlace, PeerReport};

/// A peer's report in the format of the topic `peer`. `own` is this drone's name.
pub(crate) fn peer_sighting(report: &PeerReport, own: &str) -> PeerSighting {
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
        is_own: u32::from(report.target == own),
    }
}

/// A drone's pose in the format of the topic `swarm`.
pub(crate) fn swarm_pose(place: &DronePlace) -> SwarmPose {
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
    use flockeye_contract::{FrameStamp, Peers, Pose, SwarmWay, Swarms, Topic, Track, TrackState};
    use flockeye_peer::SwarmView;

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
        let mut view = SwarmView::from("own");
        let sees = |view: &mut SwarmView, track: &Track| {
            let stamp = FrameStamp::default();
            view.hear(&PeerReport::of_track("own", &stamp, NOW_NS, track).unwrap());
        };
        let poses =
            |view: &mut SwarmView| view.places(NOW_NS).iter().map(swarm_pose).collect::<Vec<_>>();
        sees(&mut view, &seen([1.0, 0.0, 0.0]));
        view.hear(&heard("kite", "swift", [0.0, 2.0, 0.0]));
        view.hear(&heard("kite", "own", [-1.0, 0.0, 0.0]));
        let found = poses(&mut view);
        assert_eq!(Swarms::check(&Default::default(), &found), Ok(()));
        let of = |name: &str| found.iter().find(|pose| pose.name.to_string() == name).unwrap();
        assert_eq!(of("kite").way, SwarmWay::Mutual.code());
        let swift = of("swift");
        assert_eq!(
            (swift.way, swift.through.to_string().as_str()),
            (SwarmWay::Chained.code(), "kite")
        );
        let [x, y, _] = swift.own_from_drone.position;
        assert!((x - 1.0).abs() < 1e-3 && (y - 2.0).abs() < 1e-3, "{x} {y}");
        assert!(swift.covariance[0] > of("kite").covariance[0]);
        let lost = Track { state: TrackState::Lost.code(), ..seen([1.0, 0.0, 0.0]) };
        sees(&mut view, &lost);
        assert_eq!(poses(&mut view)[0].way, SwarmWay::Reported.code());
    }

    #[test]
    fn what_a_peer_says_of_this_drone_is_said_the_other_way_round_too() {
        let sighting = peer_sighting(&heard("wren", "own", [1.0, 0.0, 0.5]), "own");
        assert_eq!(Peers::check(&Default::default(), &[sighting]), Ok(()));
        assert_eq!(
            (sighting.is_own, sighting.target_from_observer.position),
            (1, [-1.0, 0.0, -0.5])
        );
        // A tilt of the observer moves it sideways as its target sees it.
        assert!(sighting.inverse_covariance[7] > sighting.covariance[7]);
    }
}
