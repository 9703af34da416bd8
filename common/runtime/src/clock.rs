//! CLOCK_MONOTONIC, the clock of all processes on a machine, and UTC, the clock of reports to
//! others.

use std::time::Duration;

use flockeye_config::Flow;
use flockeye_contract::FrameStamp;
use rustix::time::{ClockId, Timespec, clock_gettime};

/// Nanoseconds of CLOCK_MONOTONIC.
pub fn monotonic_ns() -> i64 {
    nanoseconds(clock_gettime(ClockId::Monotonic))
}

/// UTC by this machine's clock, seconds since 1970.
pub fn utc_s() -> i64 {
    clock_gettime(ClockId::Realtime).tv_sec
}

/// UTC, nanoseconds since 1970.
pub fn utc_ns() -> i64 {
    nanoseconds(clock_gettime(ClockId::Realtime))
}

/// Processor time that this process has used, nanoseconds.
pub fn processor_ns() -> i64 {
    nanoseconds(clock_gettime(ClockId::ProcessCPUTime))
}

/// Exposure time of a frame, nanoseconds of CLOCK_MONOTONIC. In a lossless run exposures have the
/// recording's clock, so the publication time is returned.
pub fn exposure_ns(stamp: &FrameStamp, flow: Flow) -> i64 {
    match flow {
        Flow::Latest => stamp.exposure_ns,
        Flow::Lossless => stamp.published_ns,
    }
}

/// Time from `now_ns` to `then_ns`; zero if that has passed.
pub fn until(then_ns: i64, now_ns: i64) -> Duration {
    Duration::from_nanos(u64::try_from(then_ns.saturating_sub(now_ns)).unwrap_or(0))
}

fn nanoseconds(time: Timespec) -> i64 {
    time.tv_sec * 1_000_000_000 + time.tv_nsec
}
