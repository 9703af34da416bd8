//! Conversion from this machine's monotonic clock to UTC.

use std::path::Path;

use flockeye_runtime::clock::monotonic_ns;
use rustix::time::{ClockId, Timespec, clock_gettime};

/// systemd-timesyncd creates this file when it has set the clock, and `systemd-time-wait-sync`
/// waits for it. `docs/PEERS.md` describes how chrony and PTP create it too.
const SYNCHRONISED: &str = "/run/systemd/timesync/synchronized";

/// Now, on this machine's CLOCK_MONOTONIC, nanoseconds.
pub fn monotonic_now_ns() -> i64 {
    monotonic_ns()
}

/// Converts an instant on CLOCK_MONOTONIC to UTC, nanoseconds since the Unix epoch. Also returns
/// whether this machine's clock is known to be synchronised with UTC. Unknown counts as no.
pub fn utc_from_monotonic(exposure_monotonic_ns: i64) -> (i64, bool) {
    let before = monotonic_ns();
    let utc_now = nanoseconds(clock_gettime(ClockId::Realtime));
    let after = monotonic_ns();
    // The thread may have been suspended between two readings; the middle is off by at most half of
    // that time.
    let monotonic_now = before + (after - before) / 2;
    (utc_at(exposure_monotonic_ns, monotonic_now, utc_now), Path::new(SYNCHRONISED).exists())
}

/// UTC of `monotonic_ns` when `monotonic_now_ns` and `utc_now_ns` are the same instant.
fn utc_at(monotonic_ns: i64, monotonic_now_ns: i64, utc_now_ns: i64) -> i64 {
    utc_now_ns.saturating_sub(monotonic_now_ns.saturating_sub(monotonic_ns))
}

fn nanoseconds(time: Timespec) -> i64 {
    time.tv_sec.saturating_mul(1_000_000_000).saturating_add(time.tv_nsec)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use std::time::{SystemTime, UNIX_EPOCH};

    use super::*;

    #[test]
    fn an_exposure_keeps_its_distance_from_now() {
        assert_eq!(utc_at(900, 1_000, 5_000_000), 4_999_900);
        assert_eq!(utc_at(1_100, 1_000, 5_000_000), 5_000_100);
        assert_eq!(utc_at(i64::MIN, 1_000, 0), -i64::MAX, "saturates instead of wrapping");
    }

    #[test]
    fn now_is_now() {
        let system_ns = || {
            let since = SystemTime::now().duration_since(UNIX_EPOCH).expect("after 1970");
            i64::try_from(since.as_nanos()).expect("before 2262")
        };
        let before = system_ns();
        let (utc, _) = utc_from_monotonic(monotonic_ns() - 1_000_000_000);
        let after = system_ns();
        // Halfway between two readings may lie on either side by what lay between them.
        let slack = (after - before).max(1_000);
        assert!(utc >= before - 1_000_000_000 - slack && utc <= after - 1_000_000_000 + slack);
    }
}
