//! Where the bodies are at one instant.

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};

use crate::eyes::Eye;

/// Where a body is, and how it moves, as the camera sees it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Placement {
    /// Pose of the body's markers in the camera frame.
    pub camera_from_markers: Isometry3<f64>,
    /// Velocity relative to the turning camera, in its frame, metres per second.
    pub velocity_in_camera: Vector3<f64>,
}

impl Placement {
    /// Position of the body's centre in the camera frame, metres.
    pub fn position(&self) -> Vector3<f64> {
        self.camera_from_markers.translation.vector
    }

    /// The placement as an eye sees it, from its own place and along the camera's axes.
    pub(crate) fn seen_from(&self, eye: &Eye) -> Self {
        Self {
            camera_from_markers: Translation3::from(-eye.position_m) * self.camera_from_markers,
            ..*self
        }
    }

    /// How fast the centre moves across the sphere, radians per second.
    pub fn angular_speed(&self) -> f64 {
        let at = self.position();
        at.cross(&self.velocity_in_camera).norm() / at.norm_squared()
    }
}

/// How the camera is turned, and how it turns.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Attitude {
    /// Its orientation in the world.
    pub world_from_camera: UnitQuaternion<f64>,
    /// Its angular velocity in its own axes, radians per second.
    pub rate_in_camera: Vector3<f64>,
}

impl Attitude {
    /// Level, turned left by `yaw` radians.
    pub fn level(yaw: f64) -> Self {
        Self {
            world_from_camera: UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw),
            rate_in_camera: Vector3::zeros(),
        }
    }

    /// The yaw, radians, -pi to pi.
    pub fn yaw(&self) -> f64 {
        let ahead = self.world_from_camera * Vector3::x();
        ahead.y.atan2(ahead.x)
    }

    /// The placement this many seconds later.
    pub(crate) fn after(&self, time_s: f64) -> Self {
        let turned = UnitQuaternion::from_scaled_axis(self.rate_in_camera * time_s);
        Self { world_from_camera: self.world_from_camera * turned, ..*self }
    }
}

/// Everything that moves, at one instant.
#[derive(Debug, Clone, PartialEq)]
pub struct Moment {
    /// Seconds since the middle of frame 0's exposure.
    pub time_s: f64,
    /// The camera's.
    pub camera: Attitude,
    /// Every body, by its index in the configuration.
    pub placements: Vec<Placement>,
}
