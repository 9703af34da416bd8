//! How the drone moves at one instant.

use nalgebra::{Isometry3, Matrix6, Vector3};

/// Along which axes the odometry's `odom` frame lies.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OdometryFrame {
    /// x east, y north, z up (REP-103).
    Enu,
    /// x forward and y left where the autopilot began, z up: it does not know north.
    Flu,
}

/// The autopilot's estimate at an instant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OdometryState {
    /// The instant, CLOCK_MONOTONIC, nanoseconds.
    pub at_ns: i64,
    /// Rises where the estimate leaps: the poses of two epochs have different origins.
    pub epoch: u32,
    /// The estimate.
    pub odometry: OdometryAt,
}

/// How the drone moves at an instant (REP-103, REP-105).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OdometryAt {
    /// Pose of `base_link` (x forward, y left, z up) in `odom`, metres.
    pub odom_from_base: Isometry3<f64>,
    /// The axes of `odom`.
    pub frame: OdometryFrame,
    /// Covariance of the pose: position (m), then rotation vector (rad), both along the axes of
    /// `odom`; none where the autopilot does not tell.
    pub covariance: Option<Matrix6<f64>>,
    /// Velocity along the axes of `base_link`, m/s.
    pub linear_velocity_m_s: Vector3<f64>,
    /// Angular velocity along the axes of `base_link`, rad/s.
    pub angular_velocity_rad_s: Vector3<f64>,
}
