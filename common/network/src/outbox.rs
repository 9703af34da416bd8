//! What waits to be sent, and what was last said of each target.
//!
//! One slot for each target: a newer report takes the place of one that has not been sent. So the
//! outbox is bounded, and what leaves it after a stall is the present, not the past.

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    sync::{Condvar, Mutex, PoisonError},
    time::Instant,
};

use flockeye_contract::{
    TrackState,
    wire::{PoseReport, WireError},
};

use crate::error::{MAX_TARGETS, NetworkError};
use crate::lock::lock;

/// A report and when it was put in.
#[derive(Debug, Clone)]
pub(crate) struct Held {
    pub(crate) report: PoseReport,
    pub(crate) since: Instant,
}

impl Held {
    /// The report as it goes out at `now`: its latency counts to the moment it is handed to the
    /// network, so the time it was held here belongs to it.
    pub(crate) fn encode(&self, now: Instant) -> Result<Vec<u8>, WireError> {
        let held = now.saturating_duration_since(self.since);
        let mut report = self.report.clone();
        report.latency_ms += held.as_secs_f64() * 1e3;
        report.to_json()
    }
}

/// Reports between the caller and the thread that sends.
#[derive(Debug, Default)]
pub(crate) struct Outbox {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct State {
    /// At most one for each target, in the order in which the targets' turns came up, so that no
    /// target starves another.
    pending: VecDeque<Held>,
    last: BTreeMap<String, Held>,
    known: BTreeSet<String>,
    overwritten: u64,
    closed: bool,
}

impl Outbox {
    /// Puts `report` in and returns at once.
    pub(crate) fn put(&self, report: &PoseReport, now: Instant) -> Result<(), NetworkError> {
        let target = &report.target;
        let mut guard = lock(&self.state);
        let state = &mut *guard;
        if state.closed {
            return Err(NetworkError::Closed);
        }
        if !state.known.contains(target) {
            if state.known.len() == MAX_TARGETS {
                return Err(NetworkError::TooManyTargets { target: target.clone() });
            }
            state.known.insert(target.clone());
        }
        let held = Held { report: report.clone(), since: now };
        if report.state == TrackState::Lost {
            state.last.remove(target);
        } else {
            state.last.insert(target.clone(), held.clone());
        }
        match state.pending.iter_mut().find(|held| held.report.target == *target) {
            Some(waiting) => {
                *waiting = held;
                state.overwritten += 1;
            }
            None => state.pending.push_back(held),
        }
        drop(guard);
        self.changed.notify_one();
        Ok(())
    }

    /// Waits for the next report to send; none once closed and empty.
    pub(crate) fn take(&self) -> Option<Held> {
        let mut state = lock(&self.state);
        loop {
            if let Some(held) = state.pending.pop_front() {
                return Some(held);
            }
            if state.closed {
                return None;
            }
            state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// The last value of every target that is not lost.
    pub(crate) fn last_values(&self) -> Vec<Held> {
        lock(&self.state).last.values().cloned().collect()
    }

    /// Reports that a newer one replaced before they were sent.
    pub(crate) fn overwritten(&self) -> u64 {
        lock(&self.state).overwritten
    }

    /// Takes nothing more; what is in is still sent.
    pub(crate) fn close(&self) {
        lock(&self.state).closed = true;
        self.changed.notify_all();
    }

    pub(crate) fn is_closed(&self) -> bool {
        lock(&self.state).closed
    }
}

#[cfg(test)]
pub(crate) mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use std::time::Duration;

    use flockeye_contract::{MeasuredBy, wire::POSE_SCHEMA};

    use super::*;

    pub(crate) fn report(target: &str) -> PoseReport {
        PoseReport {
            schema: POSE_SCHEMA.into(),
            observer: "wren".into(),
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

    #[test]
    fn while_nothing_is_sent_the_newest_of_each_target_remains_and_the_rest_is_counted() {
        let outbox = Outbox::default();
        let now = Instant::now();
        for frame in 1..=3 {
            for target in ["kite", "swift"] {
                outbox.put(&PoseReport { frame, ..report(target) }, now).unwrap();
            }
        }
        assert_eq!(outbox.overwritten(), 4);
        outbox.close();
        let sent: Vec<_> = std::iter::from_fn(|| outbox.take())
            .map(|held| (held.report.target, held.report.frame))
            .collect();
        assert_eq!(sent, [("kite".to_owned(), 3), ("swift".to_owned(), 3)]);
        assert!(matches!(outbox.put(&report("kite"), now), Err(NetworkError::Closed)));
    }

    #[test]
    fn a_lost_track_is_said_and_then_forgotten() {
        let outbox = Outbox::default();
        let now = Instant::now();
        outbox.put(&report("kite"), now).unwrap();
        assert_eq!(outbox.last_values().len(), 1);
        outbox.put(&PoseReport { state: TrackState::Lost, ..report("kite") }, now).unwrap();
        assert!(outbox.last_values().is_empty());
        assert_eq!(outbox.take().unwrap().report.state, TrackState::Lost);
    }

    #[test]
    fn targets_are_bounded() {
        let outbox = Outbox::default();
        let now = Instant::now();
        (0..MAX_TARGETS).for_each(|k| outbox.put(&report(&format!("t{k}")), now).unwrap());
        let refused = outbox.put(&report("one-more"), now);
        assert!(matches!(refused, Err(NetworkError::TooManyTargets { .. })));
        outbox.put(&report("t0"), now).expect("known targets go on");
    }

    #[test]
    fn time_held_here_counts_as_latency() {
        let since = Instant::now();
        let held = Held { report: report("kite"), since };
        let json = held.encode(since + Duration::from_millis(250)).unwrap();
        let read = PoseReport::from_json(&json).unwrap();
        assert_eq!(read.latency_ms, 270.0);
    }
}
