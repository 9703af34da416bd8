//! A track as what goes over the network.

use flockeye_contract::wire::{POSE_SCHEMA, PoseReport};
use flockeye_contract::{FrameStamp, MeasuredBy, Track, TrackState};
use flockeye_convert::upper_triangle;

/// When a frame was exposed, in the world's time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Utc {
    /// Nanoseconds since the Unix epoch.
    pub stamp_ns: i64,
    /// Whether the clock that says so is synchronised.
    pub is_synchronised: bool,
}

/// The report on a track alone. `None` for a state that this version does not know. A tentative track, which may
/// be nobody, is sent under a key of its own.
pub fn report(
    observer: &str,
    stamp: &FrameStamp,
    track: &Track,
    utc: Utc,
    latency_ns: i64,
) -> Option<PoseReport> {
    let state = TrackState::try_from(track.state).ok()?;
    Some(PoseReport {
        schema: POSE_SCHEMA.into(),
        observer: observer.to_owned(),
        target: track.name.to_string(),
        frame: stamp.sequence,
        epoch: stamp.epoch,
        stamp_utc_ns: utc.stamp_ns,
        clock_synchronised: utc.is_synchronised,
        stream_s: stamp.stream_ns as f64 * 1e-9,
        latency_ms: latency_ns as f64 * 1e-6,
        state,
        measured_by: MeasuredBy::try_from(track.measured_by).ok()?,
        markers: track.markers,
        unseen_s: track.unseen_ns as f64 * 1e-9,
        position: track.observer_from_target.position,
        orientation: track.observer_from_target.orientation,
        covariance: upper_triangle(&track.covariance),
        linear_velocity: track.linear_velocity,
        angular_velocity: track.angular_velocity,
    })
}

#[cfg(test)]
pub(crate) mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use flockeye_contract::{Pose, StageLatency};

    pub(crate) fn track(state: TrackState) -> Track {
        Track {
            observer_from_target: Pose { position: [1.0, 2.0, 3.0], ..Pose::default() },
            covariance: std::array::from_fn(|k| k as f64),
            linear_velocity: [0.1; 3],
            angular_velocity: [0.2; 3],
            measured_observer_from_target: Pose::default(),
            measured_covariance: [0.0; 36],
            predicted_observer_from_target: Pose::default(),
            predicted_covariance: [0.0; 36],
            predicted_ns: 0,
            age_ns: 0,
            unseen_ns: 500_000_000,
            latency: StageLatency::default(),
            name: "kite".into(),
            target: 0,
            track_id: 1,
            state: state.code(),
            measured_by: MeasuredBy::Decoded.code(),
            markers: 4,
            reserved: 0,
        }
    }

    pub(crate) const UTC: Utc = Utc { stamp_ns: 7, is_synchronised: true };

    #[test]
    fn a_report_says_what_the_track_says() {
        let stamp = FrameStamp { sequence: 9, stream_ns: 2_000_000_000, ..FrameStamp::default() };
        let report = report("wren", &stamp, &track(TrackState::Coasting), UTC, 12_000_000).unwrap();
        assert_eq!((report.observer.as_str(), report.target.as_str()), ("wren", "kite"));
        assert_eq!((report.frame, report.stream_s, report.unseen_s), (9, 2.0, 0.5));
        assert_eq!((report.stamp_utc_ns, report.latency_ms, report.markers), (7, 12.0, 4));
        // Row by row: 0 to 5, 7 to 11, 14 ...
        assert_eq!(report.covariance[..8], [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 7.0, 8.0]);
        assert_eq!(report.covariance[20], 35.0);
        assert!(report.to_json().is_ok());
    }
}
