//! The autopilot's time on this machine's clock.
//!
//! A message's way takes some time, and never less than none. So the least difference of arrival
//! and sensor time over the last seconds is the offset of the clocks, plus the shortest way. What
//! that way is, and what the sensor's own filter adds, is in `inertial.time_offset_ms`.

/// Half of the time over which the least difference is taken, nanoseconds. Clocks of autopilots
/// drift by some 50 us in a second, so it is not longer. Serial lines have a message without delay
/// in much less.
const HALF_WINDOW_NS: i64 = 2_500_000_000;

/// Step of the sensor's time back, or of the difference either way, that shows another clock,
/// nanoseconds.
const LEAP_NS: i64 = 1_000_000_000;

/// Maps the sensor's time to CLOCK_MONOTONIC.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct SensorClock {
    state: Option<State>,
}

#[derive(Debug, Clone, PartialEq, Eq)]
struct State {
    last_sensor_ns: i64,
    /// When this half of the window began, and the least differences in it and in the one before.
    half_began_ns: i64,
    least_ns: i64,
    least_before_ns: i64,
}

/// A sensor's time on this machine's clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ClockReading {
    /// CLOCK_MONOTONIC, nanoseconds.
    pub at_ns: i64,
    /// Whether the sensor's clock has begun anew with it.
    pub begins_anew: bool,
}

impl SensorClock {
    /// Maps a sensor time that arrived at `arrived_ns` (CLOCK_MONOTONIC).
    pub(crate) fn map(&mut self, sensor_ns: i64, arrived_ns: i64) -> ClockReading {
        let difference_ns = arrived_ns - sensor_ns;
        let state = self.state.take().filter(|state| {
            let least_ns = state.least_ns.min(state.least_before_ns);
            sensor_ns > state.last_sensor_ns - LEAP_NS && (difference_ns - least_ns).abs() < LEAP_NS
        });
        let begins_anew = state.is_none();
        let mut state = state.unwrap_or(State {
            last_sensor_ns: sensor_ns,
            half_began_ns: arrived_ns,
            least_ns: difference_ns,
            least_before_ns: difference_ns,
        });
        if arrived_ns - state.half_began_ns > HALF_WINDOW_NS {
            state.half_began_ns = arrived_ns;
            state.least_before_ns = state.least_ns;
            state.least_ns = difference_ns;
        }
        state.least_ns = state.least_ns.min(difference_ns);
        state.last_sensor_ns = sensor_ns.max(state.last_sensor_ns);
        let at_ns = sensor_ns + state.least_ns.min(state.least_before_ns);
        self.state = Some(state);
        ClockReading { at_ns, begins_anew }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    #[test]
    fn delays_do_not_move_the_time() {
        let mut clock = SensorClock::default();
        for k in 0..4000i64 {
            let sensor_ns = 5 * MS * k;
            // Ways from 2 to 20 ms.
            let way_ns = 2 * MS + (k * 7919 % 19) * MS;
            let mapped = clock.map(sensor_ns, 90_000 * MS + sensor_ns + way_ns);
            assert_eq!(mapped.begins_anew, k == 0);
            let off_ns = mapped.at_ns - (90_000 * MS + sensor_ns + 2 * MS);
            assert!((0..=18 * MS).contains(&off_ns));
            assert!(k < 19 || off_ns == 0, "sample {k}: {off_ns}");
        }
    }

    #[test]
    fn a_clock_that_drifts_is_followed() {
        let mut clock = SensorClock::default();
        for k in 0..20_000i64 {
            let sensor_ns = 5 * MS * k;
            // It loses 50 us in a second.
            let arrived_ns = sensor_ns + sensor_ns / 20_000 + (k % 3) * MS;
            let off_ns = clock.map(sensor_ns, arrived_ns).at_ns - (sensor_ns + sensor_ns / 20_000);
            assert!(off_ns.abs() < 2 * MS, "sample {k}: {off_ns}");
        }
    }

    #[test]
    fn a_restart_and_a_leap_begin_anew() {
        let mut clock = SensorClock::default();
        assert!(clock.map(50_000 * MS, 1000 * MS).begins_anew);
        assert!(!clock.map(50_005 * MS, 1005 * MS).begins_anew);
        // A message that overtook another is no restart.
        assert!(!clock.map(50_001 * MS, 1006 * MS).begins_anew);
        let restarted = clock.map(100 * MS, 9000 * MS);
        assert_eq!(restarted, ClockReading { at_ns: 9000 * MS, begins_anew: true });
        // It got the date from a satellite.
        assert!(clock.map(1_700_000_000_000 * MS, 9005 * MS).begins_anew);
    }
}
