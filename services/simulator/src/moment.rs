//! Poses of the camera and the bodies at one instant.

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};

use crate::eyes::Eye;

/// Pose and velocity of a body, relative to the camera.
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

    /// The placement relative to an eye: where its picture shows the body from the eye's position, along
    /// the camera's axes.
    pub(crate) fn seen_from(&self, eye: &Eye) -> Self {
        Self {
            camera_from_markers: eye
                .shown(&(Translation3::from(-eye.position_m) * self.camera_from_markers)),
            ..*self
        }
    }

    /// Angular speed of the body's centre as seen by the camera, radians per second.
    pub fn angular_speed(&self) -> f64 {
        let at = self.position();
        at.cross(&self.velocity_in_camera).norm() / at.norm_squared()
    }
}

/// Orientation and angular velocity of the camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Attitude {
    /// Orientation in the world.
    pub world_from_camera: UnitQuaternion<f64>,
    /// Angular velocity along the camera's axes, radians per second.
    pub rate_in_camera: Vector3<f64>,
}

impl Attitude {
    /// A level camera at rest, turned left by `yaw` radians.
    pub fn level(yaw: f64) -> Self {
        Self {
            world_from_camera: UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw),
            rate_in_camera: Vector3::zeros(),
        }
    }

    /// Yaw of the camera, radians, -pi to pi.
    pub fn yaw(&self) -> f64 {
        let ahead = self.world_from_camera * Vector3::x();
        ahead.y.atan2(ahead.x)
    }

    /// The attitude `time_s` seconds later.
    pub(crate) fn after(&self, time_s: f64) -> Self {
        let turned = UnitQuaternion::from_scaled_axis(self.rate_in_camera * time_s);
        Self { world_from_camera: self.world_from_camera * turned, ..*self }
    }
}

/// Attitude of the camera and placements of all bodies at one instant.
#[derive(Debug, Clone, PartialEq)]
pub struct Moment {
    /// Seconds since the middle of frame 0's exposure.
    pub time_s: f64,
    /// Attitude of the camera.
    pub camera: Attitude,
    /// Placement of each body, by its index in the configuration.
    pub placements: Vec<Placement>,
}
