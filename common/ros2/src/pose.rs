//! Relative poses of drones, and their conversion to messages.

use flockeye_contract::wire::shortened;
use nalgebra::{Quaternion, UnitQuaternion, Vector3};

use crate::error::Ros2Error;
use crate::messages::{
    Header, OdometryMessage, PoseWithCovariance, PoseWithCovarianceStamped, Time, TransformStamped,
};

/// The variance that means "unknown", (m/s)² or (rad/s)²: so large that a filter ignores the value.
/// ROS has no other code for it, and 0 would mean an exact value.
pub const UNKNOWN_VARIANCE: f64 = 1e6;

/// Maximum difference of a quaternion's norm from 1.
const NORM_TOLERANCE: f64 = 1e-3;

/// The pose of one drone relative to another.
#[derive(Debug, Clone, PartialEq)]
pub struct RelativePose {
    /// Name of the other drone: the neighbour in the observer's sighting, or the peer with a
    /// sighting of the observer.
    pub name: String,
    /// Mid-exposure, nanoseconds since the Unix epoch.
    pub stamp_utc_ns: i64,
    /// Position of the target drone in the frame of the drone with the camera, metres. Axes: x
    /// forward, y left, z up (REP-103).
    pub position: [f64; 3],
    /// Orientation of the target drone in the same frame, quaternion x y z w.
    pub orientation: [f64; 4],
    /// Covariance 6x6, row by row: position (m), then rotation vector (rad), both in the same
    /// frame.
    pub covariance: [f64; 36],
}

/// The observer's pose in a peer's sighting, and its velocity relative to the peer, along the
/// peer's axes.
#[derive(Debug, Clone, PartialEq)]
pub struct ObserverSeen {
    /// The observer's pose in the peer's frame, with the peer's name.
    pub pose: RelativePose,
    /// Linear velocity, m/s.
    pub linear_velocity: [f64; 3],
    /// Angular velocity, rad/s.
    pub angular_velocity: [f64; 3],
}

/// The frame name of a drone's body. `drone` is its name in ROS.
fn body_frame(drone: &str) -> String {
    format!("{drone}/base_link")
}

/// Converts a peer's sighting of the observer to a message. Both names are those in ROS.
pub(crate) fn odometry(
    seen: &ObserverSeen,
    stamp: Time,
    observer: &str,
    peer: &str,
) -> OdometryMessage {
    let [x, y, z, w] = seen.pose.orientation;
    let peer_from_observer = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
    // ROS expresses velocities along the axes of the moving drone.
    let turned = |along| peer_from_observer.inverse_transform_vector(&Vector3::from(along)).into();
    OdometryMessage {
        header: Header { stamp, frame_id: body_frame(peer) },
        child_frame_id: body_frame(observer),
        pose: seen.pose.with_covariance(),
        linear_velocity: turned(seen.linear_velocity),
        angular_velocity: turned(seen.angular_velocity),
        velocity_covariance: std::array::from_fn(|row| {
            std::array::from_fn(|column| if row == column { UNKNOWN_VARIANCE } else { 0.0 })
        }),
    }
}

impl RelativePose {
    /// The neighbour's pose as a message. `observer` is a name in ROS ([`crate::ros_name`]).
    ///
    /// # Errors
    /// [`Ros2Error::Pose`] and [`Ros2Error::Stamp`].
    pub fn message(&self, observer: &str) -> Result<PoseWithCovarianceStamped, Ros2Error> {
        Ok(PoseWithCovarianceStamped {
            header: Header { stamp: self.check()?, frame_id: body_frame(observer) },
            pose: self.with_covariance(),
        })
    }

    /// The neighbour's pose as a transform; both names are those in ROS. The child's name contains
    /// both drones', because a frame has only one parent, and a drone may have several observers.
    ///
    /// # Errors
    /// [`Ros2Error::Pose`] and [`Ros2Error::Stamp`].
    pub fn transform(&self, observer: &str, target: &str) -> Result<TransformStamped, Ros2Error> {
        Ok(TransformStamped {
            header: Header { stamp: self.check()?, frame_id: body_frame(observer) },
            child_frame_id: format!("{target}_seen_by_{observer}"),
            translation: self.position,
            rotation: self.orientation,
        })
    }

    fn with_covariance(&self) -> PoseWithCovariance {
        PoseWithCovariance {
            position: self.position,
            orientation: self.orientation,
            covariance: std::array::from_fn(|row| {
                std::array::from_fn(|column| self.covariance[6 * row + column])
            }),
        }
    }

    /// Checks the pose; returns its time.
    pub(crate) fn check(&self) -> Result<Time, Ros2Error> {
        let name = &self.name;
        check_finite(name, "a coordinate of the position", &self.position)?;
        check_finite(name, "a part of the orientation", &self.orientation)?;
        check_finite(name, "a part of the covariance", &self.covariance)?;
        let refused =
            |what, found, reason| Ros2Error::Pose { name: shortened(name), what, found, reason };
        let norm = self.orientation.iter().map(|part| part * part).sum::<f64>().sqrt();
        if (norm - 1.0).abs() > NORM_TOLERANCE {
            return Err(refused("the orientation's norm", norm, "must be 1"));
        }
        if let Some(variance) = (0..6).map(|k| self.covariance[7 * k]).find(|found| *found < 0.0) {
            return Err(refused("a variance", variance, "must not be negative"));
        }
        Time::from_utc_ns(self.stamp_utc_ns).ok_or_else(|| Ros2Error::Stamp {
            name: shortened(name),
            stamp_utc_ns: self.stamp_utc_ns,
        })
    }
}

impl ObserverSeen {
    /// Checks the pose and the velocities; returns the time.
    pub(crate) fn check(&self) -> Result<Time, Ros2Error> {
        let name = &self.pose.name;
        check_finite(name, "a part of the velocity", &self.linear_velocity)?;
        check_finite(name, "a part of the angular velocity", &self.angular_velocity)?;
        self.pose.check()
    }
}

fn check_finite(name: &str, what: &'static str, values: &[f64]) -> Result<(), Ros2Error> {
    match values.iter().find(|value| !value.is_finite()) {
        None => Ok(()),
        Some(found) => Err(Ros2Error::Pose {
            name: shortened(name),
            what,
            found: *found,
            reason: "must be finite",
        }),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    fn pose() -> RelativePose {
        RelativePose {
            name: "kite".into(),
            stamp_utc_ns: 1_700_000_000_000_000_123,
            position: [1.0, -2.0, 0.5],
            // A quarter turn to the left.
            orientation: [0.0, 0.0, 0.5_f64.sqrt(), 0.5_f64.sqrt()],
            covariance: std::array::from_fn(|k| k as f64),
        }
    }

    #[test]
    fn a_pose_is_in_the_observers_frame_and_its_covariance_keeps_its_order() {
        let message = pose().message("wren").unwrap();
        assert_eq!(message.header.frame_id, "wren/base_link");
        assert_eq!((message.header.stamp.sec, message.header.stamp.nanosec), (1_700_000_000, 123));
        assert_eq!(message.pose.covariance[1][3], 9.0);
        assert_eq!(message.pose.position, [1.0, -2.0, 0.5]);
    }

    #[test]
    fn a_transform_has_one_parent_whoever_else_sees_its_target() {
        let pose = pose();
        let message = pose.transform("wren", "kite").unwrap();
        assert_eq!(message.header.frame_id, "wren/base_link");
        assert_eq!(message.child_frame_id, "kite_seen_by_wren");
        assert_eq!(message.rotation, pose.orientation);
    }

    #[test]
    fn a_velocity_is_turned_into_the_axes_of_who_moves() {
        let (linear_velocity, angular_velocity) = ([0.0, 2.0, 0.0], [0.3, 0.0, 0.1]);
        let seen = ObserverSeen { pose: pose(), linear_velocity, angular_velocity };
        let message = odometry(&seen, Time::default(), "wren", "kite");
        assert_eq!(message.header.frame_id, "kite/base_link");
        assert_eq!(message.child_frame_id, "wren/base_link");
        // Turned to the left, it flies to the peer's left, which is straight ahead for itself.
        let (linear, angular) = (message.linear_velocity, message.angular_velocity);
        let near = |found: f64, wanted: f64| assert!((found - wanted).abs() < 1e-12, "{found}");
        near(linear[0], 2.0);
        near(linear[1], 0.0);
        near(angular[1], -0.3);
        near(angular[2], 0.1);
        assert_eq!(message.velocity_covariance[5][5], UNKNOWN_VARIANCE);
        assert_eq!(message.velocity_covariance[5][4], 0.0);
    }

    #[test]
    fn what_is_no_pose_is_refused_with_its_value() {
        let refused = |change: fn(&mut RelativePose)| {
            let mut pose = pose();
            change(&mut pose);
            pose.check().expect_err("refused").to_string()
        };
        assert!(refused(|pose| pose.position[2] = f64::NAN).contains("position is NaN"));
        assert!(refused(|pose| pose.covariance[35] = f64::INFINITY).contains("covariance is inf"));
        assert!(refused(|pose| pose.covariance[35] = -1.0).contains("variance is -1.0"));
        assert!(refused(|pose| pose.orientation = [0.0; 4]).contains("norm is 0.0"));
        assert!(refused(|pose| pose.stamp_utc_ns = i64::MAX).contains("9223372036854775807 ns"));
        let (linear_velocity, angular_velocity) = ([0.0; 3], [f64::NAN, 0.0, 0.0]);
        let seen = ObserverSeen { pose: pose(), linear_velocity, angular_velocity };
        assert!(seen.check().expect_err("refused").to_string().contains("angular velocity is NaN"));
    }
}
