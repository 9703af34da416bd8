//! Processing of each message: reports for the swarm, and the peers' sightings for the pipeline. It
//! has no port, no clock and no network.

use std::collections::BTreeMap;

use flockeye_config::Flow;
use flockeye_contract::wire::{ClockOffset, FrameReport};
use flockeye_contract::{OdometrySample, PeerSighting, Rotation, SwarmPose, Track, TrackHeader};
use flockeye_convert::camera_turn;
use flockeye_network::{ClockReading, TimedSighting};
use flockeye_peer::{PeerReport, SwarmView};
use flockeye_runtime::clock::exposure_ns;
use flockeye_runtime::newest::Newest;
use nalgebra::UnitQuaternion;

use crate::frame::Gathering;
use crate::odometry::OwnOdometry;
use crate::selection::FrameSelection;
use crate::swarm::{peer_sighting, swarm_pose};

/// The gateway's state.
#[derive(Debug)]
pub(crate) struct Core {
    observer_from_camera: UnitQuaternion<f64>,
    flow: Flow,
    newest: Newest,
    selection: FrameSelection,
    gathering: Gathering,
    odometry: OwnOdometry,
    swarm: SwarmView,
}

impl Core {
    /// The core of the drone `observer`, whose camera is turned by `observer_from_camera`.
    /// `report_hz` is `gateway.report_hz`.
    pub(crate) fn new(
        observer: &str,
        observer_from_camera: UnitQuaternion<f64>,
        flow: Flow,
        report_hz: Option<f64>,
    ) -> Self {
        Self {
            observer_from_camera,
            flow,
            newest: Newest::default(),
            selection: FrameSelection::new(report_hz),
            gathering: Gathering::default(),
            odometry: OwnOdometry::default(),
            swarm: SwarmView::from(observer),
        }
    }

    /// Takes a rotation of this drone.
    pub(crate) fn on_rotation(&mut self, rotation: &Rotation) {
        if let Some(turn) = camera_turn(rotation) {
            self.swarm.turned(&turn.in_frame(&self.observer_from_camera));
        }
    }

    /// Takes the autopilot's estimate of this drone's motion.
    pub(crate) fn on_odometry(&mut self, sample: &OdometrySample) {
        self.odometry.add(sample);
    }

    /// Takes tracks of a frame. Returns the frame's report where there is news for the swarm, and
    /// the time since the exposure, nanoseconds. `clocks` returns the offsets of the peers' clocks.
    pub(crate) fn on_tracks(
        &mut self,
        header: &TrackHeader,
        tracks: &[Track],
        now: ClockReading,
        clocks: impl FnOnce() -> BTreeMap<String, ClockOffset>,
    ) -> Option<(FrameReport, i64)> {
        let TrackHeader { stamp, is_last, .. } = header;
        let exposure_ns = exposure_ns(stamp, self.flow);
        for track in self.newest.tracks(stamp, tracks) {
            let report = PeerReport::of_track(self.swarm.own(), stamp, exposure_ns, track);
            if let Some(report) = report {
                self.swarm.hear(&report);
            }
        }
        let is_reported = self.selection.admits(stamp, exposure_ns);
        if !is_reported || !self.gathering.take(stamp, tracks, *is_last != 0, now.monotonic_ns) {
            return None;
        }
        let latency_ns = now.monotonic_ns - exposure_ns;
        let report = FrameReport {
            observer: self.swarm.own().to_owned(),
            stamp_utc_ns: exposure_ns.saturating_add(now.utc_less_monotonic_ns()),
            clock_synchronised: now.is_synchronised,
            latency_ms: latency_ns as f64 * 1e-6,
            odometry: self.odometry.at(exposure_ns),
            ..self.gathering.report(now.monotonic_ns, clocks)
        };
        Some((report, latency_ns))
    }

    /// Takes a peer's sighting. Returns it in the format of the topic `peer`; none for this drone's
    /// own.
    pub(crate) fn on_sighting(&mut self, heard: &TimedSighting) -> Option<PeerSighting> {
        let report = PeerReport::from(heard);
        (report.observer != self.swarm.own()).then(|| {
            self.swarm.hear(&report);
            peer_sighting(&report, self.swarm.own())
        })
    }

    /// Poses of all drones at an instant of CLOCK_MONOTONIC.
    pub(crate) fn swarm(&mut self, at_ns: i64) -> Vec<SwarmPose> {
        self.swarm.places(at_ns).iter().map(swarm_pose).collect()
    }

    /// The observers that are left out, because their reports contradict the others'.
    pub(crate) fn left_out(&self) -> Vec<String> {
        self.swarm.left_out()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use flockeye_contract::{FrameStamp, Pose, TrackState};

    use super::*;
    use crate::frame::tests::{frame_report, track};

    const NOW: ClockReading = ClockReading {
        monotonic_ns: 10_000_000_000,
        utc_ns: 10_000_001_000,
        is_synchronised: true,
    };

    fn core(report_hz: Option<f64>) -> Core {
        Core::new("wren", UnitQuaternion::identity(), Flow::Latest, report_hz)
    }

    fn header(sequence: u64) -> TrackHeader {
        let exposure_ns = NOW.monotonic_ns - 20_000_000 + 33_000_000 * sequence as i64;
        let stamp = FrameStamp { sequence, exposure_ns, ..FrameStamp::default() };
        TrackHeader { stamp, ..TrackHeader::default() }
    }

    fn take(core: &mut Core, sequence: u64, state: TrackState) -> Option<(FrameReport, i64)> {
        core.on_tracks(&header(sequence), &[track(state)], NOW, BTreeMap::new)
    }

    #[test]
    fn a_track_is_reported_at_once_with_its_exposure_on_both_clocks() {
        let (report, latency_ns) = take(&mut core(None), 0, TrackState::Confirmed).unwrap();
        assert_eq!(latency_ns, 20_000_000);
        assert_eq!((report.observer.as_str(), report.clock_synchronised), ("wren", true));
        let FrameReport { stamp_utc_ns, latency_ms, targets, odometry, .. } = report;
        assert_eq!((stamp_utc_ns, latency_ms), (9_980_001_000, 20.0));
        assert_eq!((targets.len(), targets[0].name.as_str(), odometry), (1, "kite", None));
    }

    #[test]
    fn a_report_says_where_the_drone_was_at_the_exposure() {
        let mut core = core(None);
        let exposure_ns = header(0).stamp.exposure_ns;
        for (after_ms, x) in [(-10, 1.0), (10, 3.0)] {
            core.on_odometry(&OdometrySample {
                odom_from_observer: Pose { position: [x, 0.0, 0.0], ..Pose::default() },
                at_ns: exposure_ns + after_ms * 1_000_000,
                ..OdometrySample::default()
            });
        }
        let (report, _) = take(&mut core, 0, TrackState::Confirmed).unwrap();
        let position = report.odometry.map(|odometry| odometry.position[0]);
        assert!(position.is_some_and(|x| (x - 2.0).abs() < 1e-9), "{position:?}");
    }

    #[test]
    fn frames_are_reported_at_the_pace_asked_for_and_tracks_reach_the_estimate_all_the_same() {
        let mut core = core(Some(15.0));
        let mut small = track(TrackState::Confirmed);
        small.covariance = [0.0; 36];
        (0..6).for_each(|k| small.covariance[7 * k] = 1e-5);
        small.measured_covariance = small.covariance;
        let reported = (0..20).filter(|&sequence| {
            core.on_tracks(&header(sequence), &[small], NOW, BTreeMap::new).is_some()
        });
        assert_eq!(reported.count(), 10);
        let poses = core.swarm(header(19).stamp.exposure_ns);
        assert_eq!(poses.len(), 1);
        assert!((poses[0].seen_ns - header(19).stamp.exposure_ns).abs() < 1_000);
    }

    #[test]
    fn tentative_tracks_are_not_reported() {
        assert!(take(&mut core(None), 0, TrackState::Tentative).is_none());
    }

    #[test]
    fn what_this_drone_reports_itself_is_no_sighting_of_a_peer() {
        let mut core = core(None);
        let heard = |observer: &str| TimedSighting {
            arrived_monotonic_ns: NOW.monotonic_ns,
            exposure_monotonic_ns: NOW.monotonic_ns,
            exposure_deviation_ns: 100_000,
            report: frame_report(observer, track(TrackState::Confirmed))
                .sightings()
                .next()
                .unwrap(),
        };
        assert!(core.on_sighting(&heard("wren")).is_none());
        assert!(core.swarm(NOW.monotonic_ns).is_empty(), "nor does it count in the estimate");
        let sighting = core.on_sighting(&heard("swift")).unwrap();
        assert_eq!((sighting.observer.to_string().as_str(), sighting.is_own), ("swift", 0));
    }
}
