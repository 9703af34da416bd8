//! Selection of the samples to publish: those of one autopilot, in one kind of message, on this
//! machine's clock.

use flockeye_contract::{ImuSample, MAX_IMU_RATE};

use crate::message::{AutopilotSample, MessageKind};
use crate::sensor_clock::SensorClock;

/// Time without samples after which another autopilot or another message is accepted, nanoseconds.
const SILENT_NS: i64 = 1_000_000_000;

/// Sender of a message: system and component.
pub(crate) type Sender = (u32, u8);

/// The component that is the autopilot. Gimbals and cameras on the same line have sensors of their
/// own.
pub(crate) const AUTOPILOT: u8 = 1;

/// The samples of one sensor.
#[derive(Debug, Default)]
pub(crate) struct Core {
    clock: Option<SensorClock>,
    last: Option<LastSample>,
    /// Number of restarts of the sensor's clock.
    pub(crate) epoch: u32,
    has_begun: bool,
    last_at_ns: i64,
}

#[derive(Debug, Clone, Copy)]
struct LastSample {
    sender: Sender,
    kind: MessageKind,
    at_ns: i64,
}

impl Core {
    /// Converts a sample that arrived at `arrived_ns` (CLOCK_MONOTONIC) to the published form.
    /// `None` if it is not published: it comes from another drone or component, a better message
    /// has the same data, it is not new, or its rate is invalid.
    pub(crate) fn on_sample(
        &mut self,
        sender: Sender,
        sample: &AutopilotSample,
        arrived_ns: i64,
    ) -> Option<ImuSample> {
        let is_rate = sample.rate.iter().all(|rate| rate.abs() < MAX_IMU_RATE);
        if sender.1 != AUTOPILOT || !is_rate {
            return None;
        }
        let last = self.last.filter(|last| arrived_ns - last.at_ns < SILENT_NS);
        if last.is_some_and(|last| last.sender != sender || last.kind > sample.kind) {
            return None;
        }
        // Another sensor has another clock.
        let is_another = last.is_none_or(|last| last.kind != sample.kind);
        if is_another {
            self.clock = None;
        }
        self.last = Some(LastSample { sender, kind: sample.kind, at_ns: arrived_ns });
        // Autopilots count from their start, or from 1970: both fit.
        let sensor_ns = i64::try_from(sample.time_us).ok()?.checked_mul(1000)?;
        let (at_ns, begins_anew) = SensorClock::map(&mut self.clock, sensor_ns, arrived_ns);
        if begins_anew && std::mem::replace(&mut self.has_begun, true) {
            self.epoch += 1;
            self.last_at_ns = i64::MIN;
        }
        if at_ns <= self.last_at_ns {
            return None;
        }
        self.last_at_ns = at_ns;
        let AutopilotSample { rate, specific_force, .. } = *sample;
        Some(ImuSample { at_ns, rate, specific_force })
    }

    /// Message of the newest sample, if one arrived within the last second.
    pub(crate) fn newest(&self, now_ns: i64) -> Option<MessageKind> {
        self.last.filter(|last| now_ns - last.at_ns < SILENT_NS).map(|last| last.kind)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;
    const OURS: Sender = (1, 1);

    fn sample(kind: MessageKind, time_ms: u64) -> AutopilotSample {
        AutopilotSample {
            kind,
            time_us: time_ms * 1000,
            rate: [0.1, 0.2, 0.3],
            specific_force: [0.0; 3],
        }
    }

    #[test]
    fn one_autopilot_and_its_best_message_are_taken() {
        use MessageKind::{AttitudeQuaternion, HighresImu};
        let mut core = Core::default();
        let mut taken = |sender: Sender, kind, time_ms: u64, arrived_ms: i64| {
            core.on_sample(sender, &sample(kind, time_ms), arrived_ms * MS).is_some()
        };
        assert!(taken(OURS, AttitudeQuaternion, 10, 1010));
        assert!(!taken((2, 1), HighresImu, 10, 1011), "another drone's");
        assert!(!taken((1, 154), HighresImu, 10, 1012), "a gimbal's");
        assert!(taken(OURS, HighresImu, 15, 1015));
        assert!(!taken(OURS, AttitudeQuaternion, 20, 1020), "the other is better");
        assert!(!taken(OURS, HighresImu, 15, 1021), "not new");
        assert!(taken(OURS, HighresImu, 25, 1025));
        // It falls silent.
        assert!(taken((2, 1), AttitudeQuaternion, 9000, 3000));
        assert_eq!(core.newest(3100 * MS), Some(AttitudeQuaternion));
        assert_eq!(core.newest(9000 * MS), None);
    }

    #[test]
    fn a_rate_that_is_none_is_left_out() {
        let mut core = Core::default();
        let good = sample(MessageKind::HighresImu, 10);
        for rate in [f64::NAN, 1e9] {
            let bad = AutopilotSample { rate: [0.0, rate, 0.0], ..good };
            assert_eq!(core.on_sample(OURS, &bad, 1010 * MS), None);
        }
        assert!(core.on_sample(OURS, &good, 1010 * MS).is_some());
    }

    #[test]
    fn times_rise_and_a_restart_raises_the_epoch() {
        let mut core = Core::default();
        let mut at = |time_ms: u64, arrived_ms: i64| {
            let sample = sample(MessageKind::HighresImu, time_ms);
            let sent = core.on_sample(OURS, &sample, arrived_ms * MS);
            (sent.map(|sample| sample.at_ns / MS), core.epoch)
        };
        assert_eq!(at(60_000, 100), (Some(100), 0));
        // This one came sooner after it was taken: the clocks are 2 ms closer than it seemed.
        assert_eq!(at(60_005, 103), (Some(103), 0));
        assert_eq!(at(60_010, 120), (Some(108), 0));
        assert_eq!(at(7, 200), (Some(200), 1));
        assert_eq!(at(u64::MAX / 1000, 205), (None, 1));
    }
}
