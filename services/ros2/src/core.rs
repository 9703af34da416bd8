//! Selection of the published tracks and sightings, and their conversion. It has no port and no
//! clock.

use flockeye_contract::{FrameStamp, PeerSighting, Track, TrackState};
use flockeye_ros2::{ObserverSeen, RelativePose};
use flockeye_runtime::newest::Newest;

/// The neighbours of a frame that was exposed at `stamp_utc_ns`. Tentative and lost tracks are left
/// out, and those of older frames than the newest of their target.
pub(crate) fn neighbours_of(
    tracks: &[Track],
    stamp: &FrameStamp,
    stamp_utc_ns: i64,
    newest: &mut Newest,
) -> Vec<RelativePose> {
    newest
        .tracks(stamp, tracks)
        .filter(|track| TrackState::try_from(track.state).is_ok_and(TrackState::is_present))
        .map(|track| RelativePose {
            name: track.name.to_string(),
            stamp_utc_ns,
            position: track.observer_from_target.position,
            orientation: track.observer_from_target.orientation,
            covariance: track.covariance,
        })
        .collect()
}

/// A peer's sighting of this drone, at an exposure at `stamp_utc_ns`. None for its sightings of
/// other drones and for lost tracks.
pub(crate) fn odometry_of(sighting: &PeerSighting, stamp_utc_ns: i64) -> Option<ObserverSeen> {
    let is_lost = TrackState::try_from(sighting.state) == Ok(TrackState::Lost);
    if sighting.is_own == 0 || is_lost {
        return None;
    }
    Some(ObserverSeen {
        pose: RelativePose {
            name: sighting.observer.to_string(),
            stamp_utc_ns,
            position: sighting.observer_from_target.position,
            orientation: sighting.observer_from_target.orientation,
            covariance: sighting.covariance,
        },
        linear_velocity: sighting.linear_velocity,
        angular_velocity: sighting.angular_velocity,
    })
}

#[cfg(test)]
mod tests {
    use flockeye_contract::Pose;

    use super::*;

    fn track(state: TrackState) -> Track {
        let observer_from_target = Pose { position: [1.0, 2.0, 3.0], ..Pose::default() };
        Track { name: "kite".into(), observer_from_target, state: state.code(), ..Track::default() }
    }

    #[test]
    fn tracks_that_may_be_nobody_and_lost_ones_are_left_out() {
        let is_published = |state: &TrackState| {
            let track = track(*state);
            !neighbours_of(&[track], &FrameStamp::default(), 0, &mut Newest::default()).is_empty()
        };
        let published: Vec<_> = TrackState::ALL.iter().copied().filter(is_published).collect();
        assert_eq!(published, [TrackState::Confirmed, TrackState::Coasting, TrackState::Measured]);
    }

    #[test]
    fn a_track_is_published_with_its_frames_time_and_never_after_a_newer_one() {
        let mut newest = Newest::default();
        let stamp = |sequence| FrameStamp { sequence, ..FrameStamp::default() };
        let tracks = [track(TrackState::Confirmed)];
        let found = neighbours_of(&tracks, &stamp(7), 700, &mut newest);
        let found: Vec<_> = found
            .iter()
            .map(|seen| (seen.name.as_str(), seen.stamp_utc_ns, seen.position))
            .collect();
        assert_eq!(found, [("kite", 700, [1.0, 2.0, 3.0])]);
        assert!(neighbours_of(&tracks, &stamp(6), 600, &mut newest).is_empty());
        assert_eq!(neighbours_of(&tracks, &stamp(8), 800, &mut newest).len(), 1);
    }

    #[test]
    fn sightings_of_this_drone_are_its_odometry() {
        let own = PeerSighting {
            observer: "kite".into(),
            target: "wren".into(),
            is_own: 1,
            state: TrackState::Confirmed.code(),
            observer_from_target: Pose { position: [3.0, 0.0, 0.0], ..Pose::default() },
            linear_velocity: [0.5, 0.0, 0.0],
            ..PeerSighting::default()
        };
        let found = odometry_of(&own, 900);
        let found = found.map(|seen| (seen.pose.name, seen.pose.stamp_utc_ns, seen.pose.position));
        assert_eq!(found, Some(("kite".to_owned(), 900, [3.0, 0.0, 0.0])));
        let lost = PeerSighting { state: TrackState::Lost.code(), ..own };
        let of_another = PeerSighting { is_own: 0, ..own };
        assert!(odometry_of(&lost, 0).is_none() && odometry_of(&of_another, 0).is_none());
    }
}
