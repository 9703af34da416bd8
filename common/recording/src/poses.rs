//! Neighbours' poses and transforms of a message of tracks.

use flockeye_contract::{Pose, Track, TrackState};
use flockeye_ros2::messages::{Ros2Message, TfMessage, TransformStamped};
use flockeye_ros2::{RelativePose, ros_name};

use crate::channel::ChannelKind;
use crate::error::RecordingError;

/// The poses of a message of tracks, each with its channel, and all transforms. `stamp_utc_ns` is
/// mid-exposure, nanoseconds since the Unix epoch; `observer` is this drone's name. Lost tracks and
/// invalid poses are skipped.
pub fn of_tracks(
    tracks: &[Track],
    stamp_utc_ns: i64,
    observer: &str,
) -> Result<Vec<(ChannelKind, Vec<u8>)>, RecordingError> {
    let observer = ros_name(observer);
    let mut messages = Vec::with_capacity(tracks.len() + 1);
    let mut transforms: Vec<TransformStamped> = Vec::with_capacity(tracks.len());
    for track in tracks.iter().filter(|track| track.state != TrackState::Lost.code()) {
        let name = track.name.to_string();
        let in_ros = ros_name(&name);
        let Pose { position, orientation } = track.observer_from_target;
        let covariance = track.covariance;
        let seen = RelativePose { name, stamp_utc_ns, position, orientation, covariance };
        let (Ok(pose), Ok(transform)) =
            (seen.message(&observer), seen.transform(&observer, &in_ros))
        else {
            continue;
        };
        transforms.push(transform);
        messages.push((ChannelKind::of_poses(&observer, &in_ros), pose.to_cdr()?));
    }
    if !transforms.is_empty() {
        messages.push((ChannelKind::of_transforms(), TfMessage { transforms }.to_cdr()?));
    }
    Ok(messages)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use bytemuck::Zeroable;

    #[test]
    fn lost_tracks_and_what_is_no_pose_are_left_out() {
        let pose = Pose { position: [1.0, 2.0, 3.0], orientation: [0.0, 0.0, 0.0, 1.0] };
        let track = |name: &str, state: TrackState| Track {
            observer_from_target: pose,
            name: name.into(),
            state: state.code(),
            ..Track::zeroed()
        };
        let none = Track {
            observer_from_target: Pose { position: [f64::NAN; 3], ..pose },
            ..track("kite-3", TrackState::Confirmed)
        };
        let tracks =
            [track("kite-2", TrackState::Confirmed), track("lark", TrackState::Lost), none];
        let messages = of_tracks(&tracks, 1_700_000_000_000_000_000, "wren").unwrap();
        let channels: Vec<_> = messages.iter().map(|(kind, _)| kind.topic.as_str()).collect();
        assert_eq!(channels, ["/wren/neighbours/kite_2/pose", "/tf"]);
        assert!(of_tracks(&tracks[1..], 0, "wren").unwrap().is_empty());
    }
}
