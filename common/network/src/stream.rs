//! A stream of reports, for readers that need each report and not only the latest.

use std::{
    collections::VecDeque,
    sync::{Arc, Condvar, Mutex, Weak},
    time::{Duration, Instant},
};

use flockeye_contract::wire::Sighting;
use serde::Serialize;

use flockeye_runtime::lock::lock;

/// One report with its times on this machine's clock.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TimedSighting {
    /// Arrival, CLOCK_MONOTONIC of this machine, nanoseconds.
    pub arrived_monotonic_ns: i64,
    /// Mid-exposure on this machine's CLOCK_MONOTONIC, by the estimate of the observer's clock,
    /// nanoseconds.
    pub exposure_monotonic_ns: i64,
    /// Standard deviation of the exposure time, nanoseconds.
    pub exposure_deviation_ns: i64,
    /// The report.
    pub report: Sighting,
}

/// A bounded queue of reports. A slow reader loses the oldest; their number is counted.
#[derive(Debug)]
pub struct ReportStream {
    capacity: usize,
    state: Mutex<State>,
    arrived: Condvar,
}

#[derive(Debug, Default)]
struct State {
    reports: VecDeque<TimedSighting>,
    dropped: u64,
    closed: bool,
}

impl ReportStream {
    /// Waits for the next report; none after `timeout`, or when the listener is dropped.
    pub fn recv_timeout(&self, timeout: Duration) -> Option<TimedSighting> {
        let deadline = Instant::now() + timeout;
        let mut state = lock(&self.state);
        loop {
            if let Some(heard) = state.reports.pop_front() {
                return Some(heard);
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if state.closed || left.is_zero() {
                return None;
            }
            state = match self.arrived.wait_timeout(state, left) {
                Ok((state, _)) => state,
                Err(poisoned) => poisoned.into_inner().0,
            };
        }
    }

    /// The next report, if one waits.
    pub fn try_recv(&self) -> Option<TimedSighting> {
        lock(&self.state).reports.pop_front()
    }

    /// Number of reports that were dropped because this reader was too slow.
    pub fn dropped(&self) -> u64 {
        lock(&self.state).dropped
    }

    /// Whether the listener is dropped and every report has been read.
    pub fn is_over(&self) -> bool {
        let state = lock(&self.state);
        state.closed && state.reports.is_empty()
    }
}

/// The listener's end of its streams.
#[derive(Debug, Default)]
pub(crate) struct Streams {
    streams: Mutex<Vec<Weak<ReportStream>>>,
}

impl Streams {
    /// A new stream that keeps at most `capacity` reports (at least one).
    pub(crate) fn subscribe(&self, capacity: usize) -> Arc<ReportStream> {
        let stream = Arc::new(ReportStream {
            capacity: capacity.max(1),
            state: Mutex::default(),
            arrived: Condvar::new(),
        });
        lock(&self.streams).push(Arc::downgrade(&stream));
        stream
    }

    /// Adds `heard` to every stream that still has a reader.
    pub(crate) fn send(&self, heard: &TimedSighting) {
        lock(&self.streams).retain(|stream| {
            let Some(stream) = stream.upgrade() else { return false };
            let mut state = lock(&stream.state);
            if state.reports.len() == stream.capacity {
                state.reports.pop_front();
                state.dropped += 1;
            }
            state.reports.push_back(heard.clone());
            stream.arrived.notify_one();
            true
        });
    }

    /// Closes every stream.
    pub(crate) fn close(&self) {
        for stream in lock(&self.streams).drain(..).filter_map(|stream| stream.upgrade()) {
            lock(&stream.state).closed = true;
            stream.arrived.notify_all();
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;
    use crate::outbox::tests::frame_report;

    fn heard(frame: u64) -> TimedSighting {
        let mut report = frame_report("wren", &["kite"]);
        report.frame = frame;
        TimedSighting {
            arrived_monotonic_ns: 0,
            exposure_monotonic_ns: 0,
            exposure_deviation_ns: 0,
            report: report.sightings().next().expect("kite"),
        }
    }

    #[test]
    fn a_slow_reader_loses_the_oldest_and_knows_how_many() {
        let streams = Streams::default();
        let stream = streams.subscribe(2);
        (1..=5).for_each(|frame| streams.send(&heard(frame)));
        let next = || stream.recv_timeout(Duration::ZERO).map(|heard| heard.report.frame);
        assert_eq!([next(), next(), next()], [Some(4), Some(5), None]);
        assert_eq!(stream.dropped(), 3);
        streams.close();
        assert!(stream.is_over());
    }

    #[test]
    fn a_stream_without_a_reader_is_forgotten() {
        let streams = Streams::default();
        drop(streams.subscribe(2));
        streams.send(&heard(1));
        assert!(lock(&streams.streams).is_empty());
    }
}
