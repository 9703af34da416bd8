//! What the tests of this crate share.

use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use flockeye_autopilot::NeighbourState;
use nalgebra::{Isometry3, Matrix6, Translation3, UnitQuaternion};

/// No test takes longer.
const WATCHDOG: Duration = Duration::from_secs(60);

/// Two metres ahead, one to the left, half a metre above, turned to the left by half a radian.
pub fn neighbour(name: &str, exposure_monotonic_ns: i64) -> NeighbourState {
    NeighbourState {
        name: name.into(),
        observer_from_target: Isometry3::from_parts(
            Translation3::new(2.0, 1.0, 0.5),
            UnitQuaternion::from_euler_angles(0.0, 0.0, 0.5),
        ),
        covariance: Matrix6::from_diagonal(&[0.04, 0.09, 0.16, 0.01, 0.01, 0.25].into()),
        exposure_monotonic_ns,
        is_lost: false,
    }
}

/// Microseconds of UTC.
#[allow(dead_code)]
pub fn utc_us() -> i64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_micros() as i64
}

/// Does it, and ends the test's process if that hangs.
pub fn watched<T>(work: impl FnOnce() -> T) -> T {
    let (done, is_done) = channel::<()>();
    let watchdog = std::thread::spawn(move || {
        if is_done.recv_timeout(WATCHDOG) == Err(RecvTimeoutError::Timeout) {
            eprintln!("the test hangs for {WATCHDOG:?}");
            std::process::abort();
        }
    });
    let result = work();
    drop(done);
    watchdog.join().unwrap();
    result
}
