//! What the tests of this crate share.

use std::time::{SystemTime, UNIX_EPOCH};

use flockeye_autopilot::NeighbourState;
use nalgebra::{Isometry3, Matrix6, Translation3, UnitQuaternion};

/// Two metres ahead, one to the left, half a metre above, turned to the left by half a radian.
pub(crate) fn neighbour(name: &str, exposure_monotonic_ns: i64) -> NeighbourState {
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
pub(crate) fn utc_us() -> i64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_micros() as i64
}
