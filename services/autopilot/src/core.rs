//! Conversion of tracks for the autopilot, and of its odometry for the contract. It has no port and
//! no clock.

use flockeye_autopilot::{NeighbourState, OdometryState};
use flockeye_contract::{FrameStamp, OdometrySample, Track, TrackState};
use flockeye_convert::{isometry, matrix6, pose, row_major};
use flockeye_runtime::newest::Newest;

/// The neighbours of a frame that was exposed at `exposure_monotonic_ns`. Tentative tracks are left
/// out, and those of older frames than the newest of their target.
pub(crate) fn neighbours_of(
    tracks: &[Track],
    stamp: &FrameStamp,
    exposure_monotonic_ns: i64,
    newest: &mut Newest,
) -> Vec<NeighbourState> {
    let neighbour = |track: &Track| {
        Some(NeighbourState {
            name: track.name.to_string(),
            observer_from_target: isometry(&track.observer_from_target),
            covariance: matrix6(&track.covariance),
            exposure_monotonic_ns,
            is_lost: is_lost(track.state)?,
        })
    };
    newest.tracks(stamp, tracks).filter_map(neighbour).collect()
}

/// Whether a track of this state has ended; none for a tentative or unknown state.
fn is_lost(state: u32) -> Option<bool> {
    match TrackState::try_from(state) {
        Ok(TrackState::Lost) => Some(true),
        Ok(state) if state.is_present() => Some(false),
        _ => None,
    }
}

/// The autopilot's estimate in the format of the topic `odometry`.
pub(crate) fn sample_of(state: &OdometryState, generation: u32) -> OdometrySample {
    let odometry = &state.odometry;
    OdometrySample {
        odom_from_observer: pose(&odometry.odom_from_base),
        covariance: odometry.covariance.as_ref().map_or([f64::NAN; 36], row_major),
        linear_velocity: odometry.linear_velocity_m_s.into(),
        angular_velocity: odometry.angular_velocity_rad_s.into(),
        at_ns: state.at_ns,
        epoch: state.epoch,
        generation,
    }
}

#[cfg(test)]
mod tests {
    use flockeye_autopilot::{OdometryAt, OdometryFrame};
    use flockeye_contract::{Odometries, Topic};
    use nalgebra::{Isometry3, Matrix6, Vector3};

    use super::*;

    #[test]
    fn tracks_that_may_be_nobody_are_left_out() {
        let sent: Vec<_> = TrackState::ALL.iter().map(|state| is_lost(state.code())).collect();
        // Tentative, confirmed, coasting, lost, measured.
        assert_eq!(sent, [None, Some(false), Some(false), Some(true), Some(false)]);
        assert_eq!(is_lost(99), None);
    }

    #[test]
    fn a_track_is_not_sent_after_a_newer_one() {
        let mut newest = Newest::default();
        let stamp = |sequence| FrameStamp { sequence, ..FrameStamp::default() };
        let state = TrackState::Confirmed.code();
        let tracks = [Track { name: "kite".into(), state, ..Track::default() }];
        let sent = neighbours_of(&tracks, &stamp(7), 70, &mut newest);
        assert_eq!((sent.len(), sent[0].exposure_monotonic_ns), (1, 70));
        assert!(neighbours_of(&tracks, &stamp(6), 60, &mut newest).is_empty());
    }

    #[test]
    fn odometry_keeps_its_numbers_and_says_where_no_covariance_is_known() {
        let odometry = OdometryAt {
            odom_from_base: Isometry3::translation(1.0, 2.0, 3.0),
            frame: OdometryFrame::Enu,
            covariance: Some(Matrix6::from_diagonal_element(0.04)),
            linear_velocity_m_s: Vector3::x(),
            angular_velocity_rad_s: Vector3::z(),
        };
        let state = OdometryState { at_ns: 5, epoch: 2, odometry };
        let sample = sample_of(&state, 3);
        assert_eq!(Odometries::check(&sample, &[]), Ok(()));
        assert_eq!((sample.at_ns, sample.epoch, sample.generation), (5, 2, 3));
        assert_eq!(
            (sample.odom_from_observer.position, sample.covariance[7]),
            ([1.0, 2.0, 3.0], 0.04)
        );
        let odometry = OdometryAt { covariance: None, ..odometry };
        let unknown = sample_of(&OdometryState { odometry, ..state }, 3);
        assert!(unknown.covariance.iter().all(|x| x.is_nan()));
        assert_eq!(Odometries::check(&unknown, &[]), Ok(()));
    }
}
