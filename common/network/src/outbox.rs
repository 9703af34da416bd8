//! The frame report that waits to be sent, and the last one.

use std::{collections::BTreeSet, sync::Mutex, time::Instant};

use flockeye_contract::{
    TrackState,
    wire::{FrameReport, MAX_TARGETS, TargetReport, WireError},
};
use flockeye_runtime::lock::lock;
use flockeye_runtime::slots::Slots;

use crate::error::NetworkError;

/// A report and its time of queueing.
#[derive(Debug, Clone)]
pub(crate) struct QueuedReport {
    report: FrameReport,
    since: Instant,
}

impl QueuedReport {
    /// Encodes the report for sending at `now`. Its latency counts until it is passed to Zenoh, so
    /// the time in the queue is added.
    pub(crate) fn encode(&self, now: Instant) -> Result<Vec<u8>, WireError> {
        let queued_ms = now.saturating_duration_since(self.since).as_secs_f64() * 1e3;
        let mut report = self.report.clone();
        report.latency_ms += queued_ms;
        report.to_json()
    }
}

/// The queue between the caller and the thread that sends: a newer report replaces one that waits.
#[derive(Debug, Default)]
pub(crate) struct Outbox {
    waiting: Slots<(), QueuedReport>,
    /// The last report without lost targets, which answers later queries.
    last: Mutex<Option<QueuedReport>>,
    targets: Mutex<BTreeSet<String>>,
}

impl Outbox {
    /// Queues `report` and returns at once. Refuses more targets than a listener keeps.
    pub(crate) fn put(&self, report: FrameReport, now: Instant) -> Result<(), NetworkError> {
        let mut targets = lock(&self.targets);
        for TargetReport { name, .. } in &report.targets {
            if targets.len() == MAX_TARGETS && !targets.contains(name) {
                return Err(NetworkError::TooManyTargets(name.clone()));
            }
            targets.insert(name.clone());
        }
        drop(targets);
        let mut lasting = report.clone();
        lasting.targets.retain(|target| target.state != TrackState::Lost);
        *lock(&self.last) = Some(QueuedReport { report: lasting, since: now });
        let put = self.waiting.put((), QueuedReport { report, since: now });
        put.map_err(|_| NetworkError::Closed)
    }

    /// Waits for the next report to send; none once closed and empty.
    pub(crate) fn take(&self) -> Option<QueuedReport> {
        self.waiting.take().map(|((), report)| report)
    }

    pub(crate) fn last_value(&self) -> Option<QueuedReport> {
        lock(&self.last).clone()
    }

    /// Number of reports that a newer one replaced before they were sent.
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
    use flockeye_contract::wire::FRAME_SCHEMA;

    use super::*;

    pub(crate) fn target(name: &str) -> TargetReport {
        TargetReport {
            name: name.into(),
            state: TrackState::Confirmed,
            measured_by: MeasuredBy::Decoded,
            markers: 3,
            unseen_s: 0.0,
            position: [1.0, -2.0, 0.5],
            orientation: [0.0, 0.0, 0.0, 1.0],
            covariance: [0.0; 21],
            linear_velocity: [0.1, 0.0, 0.0],
            angular_velocity: [0.0; 3],
            measured: None,
            predicted: None,
            rival: None,
            degenerate: None,
        }
    }

    pub(crate) fn frame_report(observer: &str, targets: &[&str]) -> FrameReport {
        FrameReport {
            schema: FRAME_SCHEMA.into(),
            observer: observer.into(),
            frame: 1,
            epoch: 1,
            stamp_utc_ns: 1_700_000_000_000_000_000,
            clock_synchronised: false,
            stream_s: 0.5,
            latency_ms: 20.0,
            odometry: None,
            clocks: BTreeMap::new(),
            targets: targets.iter().map(|name| target(name)).collect(),
        }
    }

    #[test]
    fn while_nothing_is_sent_the_newest_remains_and_the_rest_is_counted() {
        let outbox = Outbox::default();
        let now = Instant::now();
        for frame in 1..=3 {
            let report = FrameReport { frame, ..frame_report("wren", &["kite", "swift"]) };
            outbox.put(report, now).unwrap();
        }
        assert_eq!(outbox.overwritten(), 2);
        outbox.close();
        let sent: Vec<_> = std::iter::from_fn(|| outbox.take())
            .map(|queued| (queued.report.frame, queued.report.targets.len()))
            .collect();
        assert_eq!(sent, [(3, 2)]);
        let put = outbox.put(frame_report("wren", &["kite"]), now);
        assert!(matches!(put, Err(NetworkError::Closed)));
    }

    #[test]
    fn a_lost_track_is_sent_and_answers_no_later_query() {
        let outbox = Outbox::default();
        let now = Instant::now();
        let mut report = frame_report("wren", &["kite", "swift"]);
        report.targets[0].state = TrackState::Lost;
        outbox.put(report, now).unwrap();
        let json = outbox.take().unwrap().encode(now).unwrap();
        let sent = FrameReport::from_json(&json).unwrap();
        assert_eq!((sent.targets.len(), sent.targets[0].state), (2, TrackState::Lost));
        let last = outbox.last_value().unwrap().report;
        assert_eq!((last.targets.len(), last.targets[0].name.as_str()), (1, "swift"));
    }

    #[test]
    fn targets_are_bounded() {
        let outbox = Outbox::default();
        let now = Instant::now();
        let put = |target: &str| outbox.put(frame_report("wren", &[target]), now);
        (0..MAX_TARGETS).for_each(|k| put(&format!("t{k}")).unwrap());
        assert!(matches!(put("one-more"), Err(NetworkError::TooManyTargets(_))));
        put("t0").expect("known targets go on");
    }

    #[test]
    fn time_in_the_queue_counts_as_latency() {
        let since = Instant::now();
        let later = since + Duration::from_millis(250);
        let queued = QueuedReport { report: frame_report("wren", &["kite"]), since };
        let json = queued.encode(later).unwrap();
        assert_eq!(FrameReport::from_json(&json).unwrap().latency_ms, 270.0);
    }
}
