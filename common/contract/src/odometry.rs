//! `odometry`: motion of the observer by its autopilot's estimate.

use bytemuck::{Pod, Zeroable};
use flockeye_contract_derive::Described;
use iceoryx2::prelude::ZeroCopySend;

use crate::error::check_finite;
use crate::{ContractError, Pose};

/// Header of `odometry`. No payload. The observer's pose and velocity at one instant.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable, ZeroCopySend, Described)]
#[type_name("flockeye/OdometrySample")]
#[repr(C)]
pub struct OdometrySample {
    /// Pose of the observer in the frame in which its odometry began (REP-105's `odom`; z up).
    pub odom_from_observer: Pose,
    /// Covariance of the pose, 6x6 row-major: position (m), then rotation vector (rad), both along
    /// the axes of `odom`. NaN where it is not known.
    pub covariance: [f64; 36],
    /// Velocity of the observer along its own axes, m/s.
    pub linear_velocity: [f64; 3],
    /// Angular velocity of the observer along its own axes, rad/s.
    pub angular_velocity: [f64; 3],
    /// The instant, CLOCK_MONOTONIC, nanoseconds.
    pub at_ns: i64,
    /// Rises where the estimate jumps: the poses of two epochs have different origins.
    pub epoch: u32,
    /// Rises each time the sender's process is replaced.
    pub generation: u32,
}

impl Default for OdometrySample {
    fn default() -> Self {
        let odom_from_observer = Pose::default();
        Self { odom_from_observer, covariance: [f64::NAN; 36], ..Self::zeroed() }
    }
}

impl OdometrySample {
    /// Refuses invalid poses and velocities.
    pub fn check(&self) -> Result<(), ContractError> {
        self.odom_from_observer.check()?;
        check_finite("velocity", &self.linear_velocity)?;
        check_finite("velocity", &self.angular_velocity)
    }
}
