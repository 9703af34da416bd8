//! The drone's motion at one instant.

use nalgebra::{Isometry3, Matrix6, Vector3};

/// The axes of the odometry's `odom` frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OdometryFrame {
    /// x east, y north, z up (REP-103).
    Enu,
    /// x forward and y left at the autopilot's start, z up: north is unknown.
    Flu,
}

/// The autopilot's estimate at an instant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OdometryState {
    /// The instant, CLOCK_MONOTONIC, nanoseconds.
    pub at_ns: i64,
    /// Increases when the estimate jumps: the poses of two epochs have different origins.
    pub epoch: u32,
    /// The estimate.
    pub odometry: OdometryAt,
}

/// The drone's motion at an instant (REP-103, REP-105).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OdometryAt {
    /// Pose of `base_link` (x forward, y left, z up) in `odom`, metres.
    pub odom_from_base: Isometry3<f64>,
    /// The axes of `odom`.
    pub frame: OdometryFrame,
    /// Covariance of the pose: position (m), then rotation vector (rad), both along the axes of
    /// `odom`. None where the autopilot does not report it.
    pub covariance: Option<Matrix6<f64>>,
    /// Velocity along the axes of `base_link`, m/s.
    pub linear_velocity_m_s: Vector3<f64>,
    /// Angular velocity along the axes of `base_link`, rad/s.
    pub angular_velocity_rad_s: Vector3<f64>,
}
