//! Which tracks and sightings are published, and as what. It has no port and no clock.

use flockeye_contract::{FrameStamp, PeerSighting, Track, TrackState};
use flockeye_ros2::{NeighbourPose, ObserverSeen, RelativePose, Velocity};
use flockeye_runtime::newest::Newest;

/// What is known of earlier frames.
#[derive(Debug, Default)]
pub(crate) struct Core {
    newest: Newest,
}

impl Core {
    /// The neighbours of a frame that was exposed at `stamp_utc_ns`. Left out are tracks that may be nobody,
    /// lost ones, and those of frames older than the newest of their target.
    pub(crate) fn on_tracks(
        &mut self,
        stamp: &FrameStamp,
        stamp_utc_ns: i64,
        tracks: &[Track],
    ) -> Vec<NeighbourPose> {
        let newest = self.newest.tracks(stamp, tracks);
        let published = newest
            .filter(|track| TrackState::try_from(track.state).is_ok_and(TrackState::is_present));
        published
            .map(|track| NeighbourPose {
                target: track.name.to_string(),
                pose: RelativePose {
                    stamp_utc_ns,
                    position: track.observer_from_target.position,
                    orientation: track.observer_from_target.orientation,
                    covariance: track.covariance,
                },
            })
            .collect()
    }
}

/// Where a peer sees this drone, at an exposure at `stamp_utc_ns`. None for its sightings of other drones and
/// for lost tracks.
pub(crate) fn odometry_of(sighting: &PeerSighting, stamp_utc_ns: i64) -> Option<ObserverSeen> {
    let is_lost = TrackState::try_from(sighting.state) == Ok(TrackState::Lost);
    if sighting.is_own == 0 || is_lost {
        return None;
    }
    Some(ObserverSeen {
        peer: sighting.observer.to_string(),
        pose: RelativePose {
            stamp_utc_ns,
            position: sighting.observer_from_target.position,
            orientation: sighting.observer_from_target.orientation,
            covariance: sighting.covariance,
        },
        velocity: Some(Velocity {
            linear: sighting.linear_velocity,
            angular: sighting.angular_velocity,
        }),
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
            !Core::default().on_tracks(&FrameStamp::default(), 0, &[track]).is_empty()
        };
        let published: Vec<_> = TrackState::ALL.iter().copied().filter(is_published).collect();
        assert_eq!(published, [TrackState::Confirmed, TrackState::Coasting, TrackState::Measured]);
    }

    #[test]
    fn a_track_is_published_with_its_frames_time_and_never_after_a_newer_one() {
        let mut core = Core::default();
        let stamp = |sequence| FrameStamp { sequence, ..FrameStamp::default() };
        let tracks = [track(TrackState::Confirmed)];
        let found = core.on_tracks(&stamp(7), 700, &tracks);
        let found: Vec<_> = found
            .iter()
            .map(|seen| (seen.target.as_str(), seen.pose.stamp_utc_ns, seen.pose.position))
            .collect();
        assert_eq!(found, [("kite", 700, [1.0, 2.0, 3.0])]);
        assert!(core.on_tracks(&stamp(6), 600, &tracks).is_empty());
        assert_eq!(core.on_tracks(&stamp(8), 800, &tracks).len(), 1);
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
        let found = found.map(|seen| (seen.peer, seen.pose.stamp_utc_ns, seen.pose.position));
        assert_eq!(found, Some(("kite".to_owned(), 900, [3.0, 0.0, 0.0])));
        let lost = PeerSighting { state: TrackState::Lost.code(), ..own };
        let of_another = PeerSighting { is_own: 0, ..own };
        assert!(odometry_of(&lost, 0).is_none() && odometry_of(&of_another, 0).is_none());
    }
}
