//! The autopilot's time on this machine's clock.
//!
//! A message has a latency above zero. So the least difference of arrival and sensor time over the
//! last seconds is the offset of the clocks plus the least latency. `inertial.time_offset_ms`
//! states that latency and the delay of the sensor's own filter.

/// Half of the time over which the least difference is taken, nanoseconds. Clocks of autopilots
/// drift by some 50 us in a second, so it is not longer. On serial lines a message without delay
/// occurs much sooner.
const HALF_WINDOW_NS: i64 = 2_500_000_000;

/// Step of the sensor's time back, or of the difference either way, that proves another clock,
/// nanoseconds.
const LEAP_NS: i64 = 1_000_000_000;

/// Maps the sensor's time to CLOCK_MONOTONIC.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct SensorClock {
    last_sensor_ns: i64,
    /// Start of this half of the window, and the least differences in it and in the one before.
    half_began_ns: i64,
    least_ns: i64,
    least_before_ns: i64,
}

impl SensorClock {
    /// Maps a sensor time that arrived at `arrived_ns` (CLOCK_MONOTONIC) to that clock. Also
    /// returns whether the sensor's clock has started anew. `known` is `None` before the first
    /// sample.
    pub(crate) fn map(known: &mut Option<Self>, sensor_ns: i64, arrived_ns: i64) -> (i64, bool) {
        let difference_ns = arrived_ns - sensor_ns;
        let before = known.take().filter(|clock| {
            let least_ns = clock.least_ns.min(clock.least_before_ns);
            sensor_ns > clock.last_sensor_ns - LEAP_NS && (difference_ns - least_ns).abs() < LEAP_NS
        });
        let begins_anew = before.is_none();
        let mut clock = before.unwrap_or(Self {
            last_sensor_ns: sensor_ns,
            half_began_ns: arrived_ns,
            least_ns: difference_ns,
            least_before_ns: difference_ns,
        });
        if arrived_ns - clock.half_began_ns > HALF_WINDOW_NS {
            clock.half_began_ns = arrived_ns;
            clock.least_before_ns = clock.least_ns;
            clock.least_ns = difference_ns;
        }
        clock.least_ns = clock.least_ns.min(difference_ns);
        clock.last_sensor_ns = sensor_ns.max(clock.last_sensor_ns);
        let at_ns = sensor_ns + clock.least_ns.min(clock.least_before_ns);
        *known = Some(clock);
        (at_ns, begins_anew)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    #[test]
    fn delays_do_not_move_the_time() {
        let mut clock = None;
        for k in 0..4000i64 {
            let sensor_ns = 5 * MS * k;
            // Ways from 2 to 20 ms.
            let way_ns = 2 * MS + (k * 7919 % 19) * MS;
            let (at_ns, begins_anew) =
                SensorClock::map(&mut clock, sensor_ns, 90_000 * MS + sensor_ns + way_ns);
            assert_eq!(begins_anew, k == 0);
            let off_ns = at_ns - (90_000 * MS + sensor_ns + 2 * MS);
            assert!((0..=18 * MS).contains(&off_ns));
            assert!(k < 19 || off_ns == 0, "sample {k}: {off_ns}");
        }
    }

    #[test]
    fn a_clock_that_drifts_is_followed() {
        let mut clock = None;
        for k in 0..20_000i64 {
            let sensor_ns = 5 * MS * k;
            // It loses 50 us in a second.
            let arrived_ns = sensor_ns + sensor_ns / 20_000 + (k % 3) * MS;
            let off_ns = SensorClock::map(&mut clock, sensor_ns, arrived_ns).0
                - (sensor_ns + sensor_ns / 20_000);
            assert!(off_ns.abs() < 2 * MS, "sample {k}: {off_ns}");
        }
    }

    #[test]
    fn a_restart_and_a_leap_begin_anew() {
        let mut clock = None;
        let mut begins_anew = |sensor_ms: i64, arrived_ms: i64| {
            SensorClock::map(&mut clock, sensor_ms * MS, arrived_ms * MS).1
        };
        assert!(begins_anew(50_000, 1000));
        assert!(!begins_anew(50_005, 1005));
        // A message that overtook another is no restart.
        assert!(!begins_anew(50_001, 1006));
        assert_eq!(SensorClock::map(&mut clock, 100 * MS, 9000 * MS), (9000 * MS, true));
        // The autopilot got the date from a satellite.
        assert!(SensorClock::map(&mut clock, 1_700_000_000_000 * MS, 9005 * MS).1);
    }
}
