//! Reports that wait to be sent, and the last report of each kind.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Mutex,
    time::Instant,
};

use flockeye_contract::{
    TrackState,
    wire::{FrameReport, MAX_TARGETS, PoseReport, WireError, frame_key, pose_key, tentative_key},
};
use flockeye_runtime::lock::lock;
use flockeye_runtime::slots::{Closed, Slots};

use crate::error::NetworkError;

/// Where a report goes.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Slot {
    /// All targets of a frame.
    Frame,
    /// One target.
    Pose(String),
    /// One target whose track is not confirmed.
    Tentative(String),
}

impl Slot {
    /// The key that its reports have.
    pub(crate) fn key(&self, swarm: &str, observer: &str) -> String {
        match self {
            Self::Frame => frame_key(swarm, observer),
            Self::Pose(target) => pose_key(swarm, observer, target),
            Self::Tentative(target) => tentative_key(swarm, observer, target),
        }
    }
}

/// A report of either kind.
#[derive(Debug, Clone)]
pub(crate) enum Outgoing {
    Frame(FrameReport),
    Pose(PoseReport),
}

impl Outgoing {
    fn slot(&self) -> Slot {
        match self {
            Self::Frame(_) => Slot::Frame,
            Self::Pose(report) if report.state == TrackState::Tentative => {
                Slot::Tentative(report.target.clone())
            }
            Self::Pose(report) => Slot::Pose(report.target.clone()),
        }
    }

    /// What of it may answer a later query: nothing of those that are lost.
    fn as_last_value(&self) -> Option<Self> {
        match self {
            Self::Frame(report) => {
                let mut report = report.clone();
                report.targets.retain(|target| target.state != TrackState::Lost);
                Some(Self::Frame(report))
            }
            Self::Pose(report) => {
                let is_lasting = !matches!(report.state, TrackState::Lost | TrackState::Tentative);
                is_lasting.then(|| self.clone())
            }
        }
    }
}

/// A report and when it was put in.
#[derive(Debug, Clone)]
pub(crate) struct Held {
    report: Outgoing,
    since: Instant,
}

impl Held {
    /// The report as it goes out at `now`: its latency counts to the moment it is handed to the
    /// network, so the time it was held here belongs to it.
    pub(crate) fn encode(&self, now: Instant) -> Result<Vec<u8>, WireError> {
        let held_ms = now.saturating_duration_since(self.since).as_secs_f64() * 1e3;
        match self.report.clone() {
            Outgoing::Frame(mut report) => {
                report.latency_ms += held_ms;
                report.to_json()
            }
            Outgoing::Pose(mut report) => {
                report.latency_ms += held_ms;
                report.to_json()
            }
        }
    }
}

/// Reports between the caller and the thread that sends.
#[derive(Debug, Default)]
pub(crate) struct Outbox {
    waiting: Slots<Slot, Held>,
    said: Mutex<Said>,
}

/// What was put in so far.
#[derive(Debug, Default)]
struct Said {
    last: BTreeMap<Slot, Held>,
    targets: BTreeSet<String>,
}

impl Said {
    /// Whether there is room for one more target.
    fn admits(&mut self, target: &str) -> Result<(), NetworkError> {
        if !self.targets.contains(target) {
            if self.targets.len() == MAX_TARGETS {
                return Err(NetworkError::TooManyTargets { target: target.into() });
            }
            self.targets.insert(target.into());
        }
        Ok(())
    }
}

impl Outbox {
    /// Puts `report` in and returns at once.
    pub(crate) fn put(&self, report: Outgoing, now: Instant) -> Result<(), NetworkError> {
        let mut said = lock(&self.said);
        match &report {
            Outgoing::Pose(pose) => said.admits(&pose.target)?,
            Outgoing::Frame(frame) => {
                frame.targets.iter().try_for_each(|target| said.admits(&target.name))?;
            }
        }
        let slot = report.slot();
        match report.as_last_value() {
            Some(report) => said.last.insert(slot.clone(), Held { report, since: now }),
            None => said.last.remove(&slot),
        };
        drop(said);
        let put = self.waiting.put(slot, Held { report, since: now });
        put.map_err(|Closed| NetworkError::Closed)
    }

    /// Waits for the next report to send; none once closed and empty.
    pub(crate) fn take(&self) -> Option<(Slot, Held)> {
        self.waiting.take()
    }

    /// The last frame, and the last value of every target that is not lost.
    pub(crate) fn last_values(&self) -> BTreeMap<Slot, Held> {
        lock(&self.said).last.clone()
    }

    /// Reports that a newer one replaced before they were sent.
    pub(crate) fn overwritten(&self) -> u64 {
        self.waiting.overwritten()
    }

    /// Accepts nothing more; waiting reports are still sent.
    pub(crate) fn close(&self) {
        self.waiting.close();
    }

    pub(crate) fn is_closed(&self) -> bool {
        self.waiting.is_closed()
    }
}

#[cfg(test)]
pub(crate) mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use std::collections::BTreeMap;
    use std::time::Duration;

    use flockeye_contract::MeasuredBy;
    use flockeye_contract::wire::{FRAME_SCHEMA, POSE_SCHEMA, Sighting};

    use super::*;

    pub(crate) fn report(target: &str) -> PoseReport {
        PoseReport {
            schema: POSE_SCHEMA.into(),
            observer: if target == "robin" { "finch" } else { "wren" }.into(),
            target: target.into(),
            frame: 1,
            epoch: 1,
            stamp_utc_ns: 1_700_000_000_000_000_000,
            clock_synchronised: false,
            stream_s: 0.5,
            latency_ms: 20.0,
            state: TrackState::Confirmed,
            measured_by: MeasuredBy::Decoded,
            markers: 3,
            unseen_s: 0.0,
            position: [1.0, -2.0, 0.5],
            orientation: [0.0, 0.0, 0.0, 1.0],
            covariance: [0.0; 21],
            linear_velocity: [0.1, 0.0, 0.0],
            angular_velocity: [0.0; 3],
        }
    }

    pub(crate) fn frame_report(observer: &str, targets: &[&str]) -> FrameReport {
        let one = report("kite");
        FrameReport {
            schema: FRAME_SCHEMA.into(),
            observer: observer.into(),
            frame: one.frame,
            epoch: one.epoch,
            stamp_utc_ns: one.stamp_utc_ns,
            clock_synchronised: false,
            stream_s: one.stream_s,
            latency_ms: one.latency_ms,
            odometry: None,
            clocks: BTreeMap::new(),
            targets: targets.iter().map(|target| Sighting::from(report(target)).target).collect(),
        }
    }

    fn put(outbox: &Outbox, report: PoseReport, now: Instant) -> Result<(), NetworkError> {
        outbox.put(Outgoing::Pose(report), now)
    }

    #[test]
    fn while_nothing_is_sent_the_newest_of_each_target_remains_and_the_rest_is_counted() {
        let outbox = Outbox::default();
        let now = Instant::now();
        for frame in 1..=3 {
            for target in ["kite", "swift"] {
                put(&outbox, PoseReport { frame, ..report(target) }, now).unwrap();
            }
            let frame = FrameReport { frame, ..frame_report("wren", &["kite", "swift"]) };
            outbox.put(Outgoing::Frame(frame), now).unwrap();
        }
        assert_eq!(outbox.overwritten(), 6);
        outbox.close();
        let sent: Vec<_> = std::iter::from_fn(|| outbox.take())
            .map(|(slot, held)| match held.report {
                Outgoing::Frame(report) => (slot, report.frame),
                Outgoing::Pose(report) => (slot, report.frame),
            })
            .collect();
        let pose = |target: &str| (Slot::Pose(target.into()), 3);
        assert_eq!(sent, [pose("kite"), pose("swift"), (Slot::Frame, 3)]);
        assert!(matches!(put(&outbox, report("kite"), now), Err(NetworkError::Closed)));
    }

    #[test]
    fn a_lost_track_is_said_and_then_forgotten() {
        let outbox = Outbox::default();
        let now = Instant::now();
        put(&outbox, report("kite"), now).unwrap();
        assert_eq!(outbox.last_values().len(), 1);
        put(&outbox, PoseReport { state: TrackState::Lost, ..report("kite") }, now).unwrap();
        assert!(outbox.last_values().is_empty());
        let json = outbox.take().unwrap().1.encode(now).unwrap();
        assert_eq!(PoseReport::from_json(&json).unwrap().state, TrackState::Lost);
    }

    #[test]
    fn tentative_tracks_have_a_key_of_their_own_and_are_no_last_value() {
        let outbox = Outbox::default();
        let tentative = PoseReport { state: TrackState::Tentative, ..report("kite") };
        put(&outbox, tentative, Instant::now()).unwrap();
        assert!(outbox.last_values().is_empty());
        let (slot, _) = outbox.take().unwrap();
        assert_eq!(slot.key("s", "wren"), "flockeye/s/wren/sees/kite/tentative");
    }

    #[test]
    fn targets_are_bounded() {
        let outbox = Outbox::default();
        let now = Instant::now();
        (0..MAX_TARGETS).for_each(|k| put(&outbox, report(&format!("t{k}")), now).unwrap());
        let refused = put(&outbox, report("one-more"), now);
        assert!(matches!(refused, Err(NetworkError::TooManyTargets { .. })));
        put(&outbox, report("t0"), now).expect("known targets go on");
    }

    #[test]
    fn time_held_here_counts_as_latency() {
        let since = Instant::now();
        let later = since + Duration::from_millis(250);
        let encoded = |report: Outgoing| Held { report, since }.encode(later).unwrap();
        let pose = encoded(Outgoing::Pose(report("kite")));
        assert_eq!(PoseReport::from_json(&pose).unwrap().latency_ms, 270.0);
        let frame = encoded(Outgoing::Frame(frame_report("wren", &["kite"])));
        assert_eq!(FrameReport::from_json(&frame).unwrap().latency_ms, 270.0);
    }
}
