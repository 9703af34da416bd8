//! All targets of a frame as one report.

use std::collections::BTreeMap;

use flockeye_contract::wire::{
    ClockOffset, Degenerate, FRAME_SCHEMA, FrameReport, Measurement, Predicted, Rival, TargetReport,
};
use flockeye_contract::{FrameStamp, MeasuredBy, Pose, Track, TrackState};
use flockeye_convert::{matrix6, upper_triangle};
use nalgebra::{Matrix3, Vector3};

/// Period of reports without targets, nanoseconds.
const NOBODY_NS: i64 = 1_000_000_000;
/// Period of reports with the peers' clocks, nanoseconds.
const CLOCKS_NS: i64 = 1_000_000_000;
/// Share of the distance above which a standard deviation is no small error. There the squared
/// term, which a covariance omits, is 4 %.
const DEGENERATE_SHARE: f64 = 0.2;
/// Standard deviation above which a rotation is no small one, radians: its sine is 4 % off.
const DEGENERATE_ROTATION: f64 = 0.5;

/// Gathers the targets of a frame as they arrive.
///
/// Fusion publishes each pose as soon as it has it. So a frame's report is sent with the first of
/// its targets, and again, completely, with each further one.
#[derive(Debug, Default)]
pub(crate) struct Gathering {
    stamp: FrameStamp,
    targets: BTreeMap<u32, TargetReport>,
    reported_ns: i64,
    clocks_reported_ns: i64,
}

impl Gathering {
    /// Takes tracks of a frame. Returns whether a report is due now.
    pub(crate) fn take(
        &mut self,
        stamp: &FrameStamp,
        tracks: &[Track],
        is_last: bool,
        now_ns: i64,
    ) -> bool {
        if stamp.is_late_beside(&self.stamp) {
            return false;
        }
        if stamp.order() != self.stamp.order() {
            self.stamp = *stamp;
            self.targets.clear();
        }
        let mut is_news = false;
        for track in tracks {
            if let Some(report) = target_report(track, stamp) {
                is_news |= self.targets.get(&track.target) != Some(&report);
                self.targets.insert(track.target, report);
            }
        }
        let is_due = is_last && self.targets.is_empty() && now_ns - self.reported_ns >= NOBODY_NS;
        if is_news || is_due {
            self.reported_ns = now_ns;
        }
        is_news || is_due
    }

    /// The report of the frame with the targets so far; observer, times and odometry are left open.
    /// `clocks` is called when its period is over.
    pub(crate) fn report(
        &mut self,
        now_ns: i64,
        clocks: impl FnOnce() -> BTreeMap<String, ClockOffset>,
    ) -> FrameReport {
        let is_time = now_ns - self.clocks_reported_ns >= CLOCKS_NS;
        if is_time {
            self.clocks_reported_ns = now_ns;
        }
        FrameReport {
            schema: FRAME_SCHEMA.into(),
            observer: String::new(),
            frame: self.stamp.sequence,
            epoch: self.stamp.epoch,
            stamp_utc_ns: 0,
            clock_synchronised: false,
            stream_s: self.stamp.stream_ns as f64 * 1e-9,
            latency_ms: 0.0,
            odometry: None,
            clocks: if is_time { clocks() } else { BTreeMap::new() },
            targets: self.targets.values().cloned().collect(),
        }
    }
}

/// A track in the format of reports. `None` for tracks that peers do not get: tentative ones, which
/// may be false, and states unknown to this version.
fn target_report(track: &Track, stamp: &FrameStamp) -> Option<TargetReport> {
    let state = TrackState::try_from(track.state).ok()?;
    let measured_by = MeasuredBy::try_from(track.measured_by).ok()?;
    if state == TrackState::Tentative {
        return None;
    }
    let Pose { position, orientation } = track.observer_from_target;
    let measured = (measured_by != MeasuredBy::Nothing).then(|| Measurement {
        position: track.measured_observer_from_target.position,
        orientation: track.measured_observer_from_target.orientation,
        covariance: upper_triangle(&track.measured_covariance),
    });
    let rival = (track.is_ambiguous != 0).then(|| Rival {
        position: track.rival_observer_from_target.position,
        orientation: track.rival_observer_from_target.orientation,
        covariance: upper_triangle(&track.rival_covariance),
        lead: track.rival_lead,
    });
    // A lossless run is not in real time, so it has no predictions.
    let after_ns = track.predicted_ns.saturating_sub(stamp.exposure_ns);
    let predicted = (after_ns > 0).then(|| Predicted {
        after_s: after_ns as f64 * 1e-9,
        position: track.predicted_observer_from_target.position,
        orientation: track.predicted_observer_from_target.orientation,
        deviations: std::array::from_fn(|k| track.predicted_covariance[7 * k].max(0.0).sqrt()),
    });
    Some(TargetReport {
        name: track.name.to_string(),
        state,
        measured_by,
        markers: track.markers,
        unseen_s: track.unseen_ns as f64 * 1e-9,
        position,
        orientation,
        covariance: upper_triangle(&track.covariance),
        linear_velocity: track.linear_velocity,
        angular_velocity: track.angular_velocity,
        measured,
        rival,
        predicted,
        degenerate: degenerate(track),
    })
}

/// The directions in which a track's pose is nearly unknown.
fn degenerate(track: &Track) -> Option<Degenerate> {
    let covariance = matrix6(&track.covariance);
    let distance = Vector3::from(track.observer_from_target.position).norm();
    let position = worst(&covariance.fixed_view::<3, 3>(0, 0).into_owned());
    let rotation = worst(&covariance.fixed_view::<3, 3>(3, 3).into_owned());
    let degenerate = Degenerate {
        position: position
            .filter(|(_, deviation)| *deviation > DEGENERATE_SHARE * distance)
            .map(|(d, _)| d),
        rotation: rotation
            .filter(|(_, deviation)| *deviation > DEGENERATE_ROTATION)
            .map(|(d, _)| d),
    };
    (degenerate.position.is_some() || degenerate.rotation.is_some()).then_some(degenerate)
}

/// The direction of the largest standard deviation, and its value.
fn worst(covariance: &Matrix3<f64>) -> Option<([f64; 3], f64)> {
    let eigen = covariance.symmetric_eigen();
    let index = eigen.eigenvalues.imax();
    let deviation = eigen.eigenvalues[index].max(0.0).sqrt();
    let direction: [f64; 3] = eigen.eigenvectors.column(index).into_owned().into();
    (deviation.is_finite() && direction.iter().all(|x| x.is_finite()))
        .then_some((direction, deviation))
}

#[cfg(test)]
pub(crate) mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    pub(crate) fn track(state: TrackState) -> Track {
        Track {
            observer_from_target: Pose { position: [1.0, 2.0, 3.0], ..Pose::default() },
            covariance: std::array::from_fn(|k| k as f64),
            linear_velocity: [0.1; 3],
            angular_velocity: [0.2; 3],
            unseen_ns: 500_000_000,
            name: "kite".into(),
            track_id: 1,
            state: state.code(),
            measured_by: MeasuredBy::Decoded.code(),
            markers: 4,
            ..Track::default()
        }
    }

    /// A report of `observer` on one track.
    pub(crate) fn frame_report(observer: &str, track: Track) -> FrameReport {
        let mut gathering = Gathering::default();
        assert!(gathering.take(&FrameStamp::default(), &[track], true, 0));
        let report = gathering.report(0, BTreeMap::new);
        FrameReport { observer: observer.into(), stamp_utc_ns: 7, ..report }
    }

    #[test]
    fn a_report_says_what_the_track_says() {
        let mut gathering = Gathering::default();
        let stamp = FrameStamp { stream_ns: 2_000_000_000, ..stamp(9) };
        assert!(gathering.take(&stamp, &[track(TrackState::Coasting)], true, 0));
        let report = report(&mut gathering, 0);
        assert_eq!((report.frame, report.stream_s), (9, 2.0));
        let kite = &report.targets[0];
        assert_eq!((kite.name.as_str(), kite.state), ("kite", TrackState::Coasting));
        assert_eq!((kite.unseen_s, kite.markers, kite.position), (0.5, 4, [1.0, 2.0, 3.0]));
        // Row by row: 0 to 5, 7 to 11, 14 ...
        assert_eq!(kite.covariance[..8], [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 7.0, 8.0]);
        assert_eq!(kite.covariance[20], 35.0);
        assert!(report.to_json().is_ok());
    }

    fn stamp(sequence: u64) -> FrameStamp {
        FrameStamp { sequence, exposure_ns: 33_000_000 * sequence as i64, ..FrameStamp::default() }
    }

    fn report(gathering: &mut Gathering, now_ns: i64) -> FrameReport {
        let clock = ClockOffset { one_way_ms: 1.0, offset_ms: 2.0, deviation_ms: 0.5 };
        let report = gathering.report(now_ns, || BTreeMap::from([("kite".into(), clock)]));
        FrameReport { observer: "wren".into(), ..report }
    }

    #[test]
    fn a_frame_is_reported_at_once_and_again_when_more_is_known() {
        let mut gathering = Gathering::default();
        let [kite, swift] = [0, 1].map(|target| Track {
            target,
            name: ["kite", "swift"][target as usize].into(),
            ..track(TrackState::Confirmed)
        });
        let names = |report: FrameReport| {
            report.targets.into_iter().map(|target| target.name).collect::<Vec<_>>()
        };
        assert!(gathering.take(&stamp(7), &[kite], false, 10_000_000_000));
        assert_eq!(names(report(&mut gathering, 0)), ["kite"]);
        assert!(!gathering.take(&stamp(7), &[kite], false, 0), "nothing new");
        assert!(gathering.take(&stamp(7), &[swift], false, 0));
        assert!(!gathering.take(&stamp(7), &[], true, 0));
        assert_eq!(names(report(&mut gathering, 0)), ["kite", "swift"]);
        assert!(gathering.take(&stamp(8), &[swift], true, 0));
        assert_eq!(names(report(&mut gathering, 0)), ["swift"]);
        assert!(!gathering.take(&stamp(7), &[kite], true, 0), "late");
    }

    #[test]
    fn seeing_nobody_is_reported_once_a_second() {
        let mut gathering = Gathering::default();
        let said = (1..=90).filter(|&k| {
            let now_ns = 10_000_000_000 + 33_333_333 * k as i64;
            gathering.take(&stamp(k), &[track(TrackState::Tentative)], true, now_ns)
        });
        assert_eq!(said.count(), 3);
    }

    #[test]
    fn clocks_go_along_once_a_second() {
        let mut gathering = Gathering::default();
        let mut with_clocks = 0;
        for k in 0..60 {
            gathering.take(&stamp(k + 1), &[track(TrackState::Confirmed)], true, 0);
            let report = report(&mut gathering, 5_000_000_000 + 33_333_333 * k as i64);
            with_clocks += usize::from(!report.clocks.is_empty());
            assert!(report.to_json().is_ok());
        }
        assert_eq!(with_clocks, 2);
    }

    #[test]
    fn a_report_has_what_is_measured_foreseen_and_unknown() {
        let mut covariance = [0.0; 36];
        (0..6).for_each(|k| covariance[7 * k] = 1e-4);
        let position = Pose { position: [2.0, 0.0, 0.0], ..Pose::default() };
        let seen = Track {
            covariance,
            observer_from_target: position,
            predicted_observer_from_target: position,
            measured_observer_from_target: position,
            predicted_ns: 33_000_000 + 20_000_000,
            predicted_covariance: covariance,
            ..track(TrackState::Confirmed)
        };
        let said = target_report(&seen, &stamp(1)).unwrap();
        assert_eq!(
            said.predicted.as_ref().map(|p| (p.after_s, p.deviations[5])),
            Some((0.02, 0.01))
        );
        assert!(said.measured.is_some() && said.degenerate.is_none());
        // Half a metre along y, at 2 m; and the tilt about z is as good as unknown.
        covariance[7] = 0.25;
        covariance[35] = 0.5;
        let unsure =
            Track { covariance, measured_by: MeasuredBy::Nothing.code(), predicted_ns: 0, ..seen };
        let said = target_report(&unsure, &stamp(1)).unwrap();
        let Degenerate { position, rotation } = said.degenerate.unwrap();
        assert_eq!(position.map(|d| d.map(f64::abs)), Some([0.0, 1.0, 0.0]));
        assert_eq!(rotation.map(|d| d.map(f64::abs)), Some([0.0, 0.0, 1.0]));
        assert!(said.measured.is_none() && said.predicted.is_none());
    }

    #[test]
    fn an_ambiguous_track_has_both_poses_in_the_report() {
        let mirror = Pose { orientation: [0.6, 0.0, 0.0, 0.8], ..Pose::default() };
        let ambiguous = Track {
            measured_by: MeasuredBy::Nothing.code(),
            rival_observer_from_target: mirror,
            rival_covariance: [0.01; 36],
            rival_lead: 1.5,
            is_ambiguous: 1,
            ..track(TrackState::Coasting)
        };
        let said = target_report(&ambiguous, &stamp(1)).unwrap();
        let rival = said.rival.expect("it is possible");
        assert_eq!((rival.orientation, rival.lead), (mirror.orientation, 1.5));
        assert_eq!(said.orientation, Pose::default().orientation);
        let decided = Track { is_ambiguous: 0, ..ambiguous };
        assert!(target_report(&decided, &stamp(1)).unwrap().rival.is_none());
    }
}
