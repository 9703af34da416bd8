//! Poses as they come in, and the messages that they become.

use flockeye_contract::wire::shortened;
use nalgebra::{Quaternion, UnitQuaternion, Vector3};

use crate::error::Ros2Error;
use crate::messages::{
    self, Header, Matrix6, Odometry, Point, Pose, PoseWithCovariance, PoseWithCovarianceStamped,
    Time, Transform, TransformStamped, Twist, TwistWithCovariance,
};

/// The variance that stands for "not known", (m/s)² or (rad/s)²: so large that no filter heeds the value.
/// ROS has no other way to say so, and 0 would mean that it is known exactly.
pub const UNKNOWN_VARIANCE: f64 = 1e6;

/// How far a quaternion's norm may be from 1.
const NORM_TOLERANCE: f64 = 1e-3;

/// Where one drone sees another.
#[derive(Debug, Clone, PartialEq)]
pub struct RelativePose {
    /// Mid-exposure, nanoseconds since the Unix epoch.
    pub stamp_utc_ns: i64,
    /// Origin of the seen drone in the seeing one's frame (x forward, y left, z up; REP-103), metres.
    pub position: [f64; 3],
    /// Orientation, seeing drone from seen one, quaternion x y z w.
    pub orientation: [f64; 4],
    /// Covariance 6x6, row by row: position (m), then rotation vector (rad), both in the seeing drone's
    /// frame.
    pub covariance: [f64; 36],
}

/// Where the observer sees a neighbour.
#[derive(Debug, Clone, PartialEq)]
pub struct NeighbourPose {
    /// The neighbour's name.
    pub target: String,
    /// Its pose in the observer's frame.
    pub pose: RelativePose,
}

impl NeighbourPose {
    /// The pose as a message and as a transform. Both names are those in ROS ([`crate::ros_name`]).
    ///
    /// # Errors
    /// [`Ros2Error::Pose`] and [`Ros2Error::Stamp`].
    pub fn messages(
        &self,
        observer: &str,
        target: &str,
    ) -> Result<(PoseWithCovarianceStamped, TransformStamped), Ros2Error> {
        let stamp = self.pose.check(&self.target)?;
        let pose = pose_message(&self.pose, stamp, observer);
        Ok((pose, transform(&self.pose, stamp, observer, target)))
    }
}

/// Where a peer sees the observer.
#[derive(Debug, Clone, PartialEq)]
pub struct ObserverSeen {
    /// The peer's name.
    pub peer: String,
    /// The observer's pose in the peer's frame.
    pub pose: RelativePose,
    /// The observer's velocity, where the peer knows it.
    pub velocity: Option<Velocity>,
}

/// A velocity relative to the drone that sees, along that drone's axes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Velocity {
    /// Linear velocity, m/s.
    pub linear: [f64; 3],
    /// Angular velocity, rad/s.
    pub angular: [f64; 3],
}

/// The frame of a drone's body. `drone` is its name in ROS.
fn body_frame(drone: &str) -> String {
    format!("{drone}/base_link")
}

/// The neighbour's pose as a message. Both names are those in ROS.
pub(crate) fn pose_message(
    pose: &RelativePose,
    stamp: Time,
    observer: &str,
) -> PoseWithCovarianceStamped {
    PoseWithCovarianceStamped {
        header: Header { stamp, frame_id: body_frame(observer) },
        pose: with_covariance(pose),
    }
}

/// The neighbour's pose as a transform. The child's name has both drones', so that a drone that is seen by
/// several does not get several parents.
pub(crate) fn transform(
    pose: &RelativePose,
    stamp: Time,
    observer: &str,
    target: &str,
) -> TransformStamped {
    TransformStamped {
        header: Header { stamp, frame_id: body_frame(observer) },
        child_frame_id: format!("{target}_seen_by_{observer}"),
        transform: Transform {
            translation: vector(pose.position),
            rotation: quaternion(pose.orientation),
        },
    }
}

/// The observer as a peer sees it. Both names are those in ROS.
pub(crate) fn odometry(seen: &ObserverSeen, stamp: Time, observer: &str, peer: &str) -> Odometry {
    Odometry {
        header: Header { stamp, frame_id: body_frame(peer) },
        child_frame_id: body_frame(observer),
        pose: with_covariance(&seen.pose),
        twist: TwistWithCovariance {
            twist: seen
                .velocity
                .map_or_else(Twist::default, |velocity| twist(seen.pose.orientation, velocity)),
            covariance: std::array::from_fn(|row| {
                std::array::from_fn(|column| if row == column { UNKNOWN_VARIANCE } else { 0.0 })
            }),
        },
    }
}

/// A velocity along the axes of the drone that is seen, as ROS wants it.
fn twist(seeing_from_seen: [f64; 4], velocity: Velocity) -> Twist {
    let [x, y, z, w] = seeing_from_seen;
    let seeing_from_seen = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
    let turned = |along: [f64; 3]| {
        vector(seeing_from_seen.inverse_transform_vector(&Vector3::from(along)).into())
    };
    Twist { linear: turned(velocity.linear), angular: turned(velocity.angular) }
}

fn with_covariance(pose: &RelativePose) -> PoseWithCovariance {
    let [x, y, z] = pose.position;
    PoseWithCovariance {
        pose: Pose { position: Point { x, y, z }, orientation: quaternion(pose.orientation) },
        covariance: rows(&pose.covariance),
    }
}

fn rows(matrix: &[f64; 36]) -> Matrix6 {
    std::array::from_fn(|row| std::array::from_fn(|column| matrix[6 * row + column]))
}

fn vector([x, y, z]: [f64; 3]) -> messages::Vector3 {
    messages::Vector3 { x, y, z }
}

fn quaternion([x, y, z, w]: [f64; 4]) -> messages::Quaternion {
    messages::Quaternion { x, y, z, w }
}

impl RelativePose {
    /// Refuses what is no pose; gives its time. `name` is the other drone's.
    pub(crate) fn check(&self, name: &str) -> Result<Time, Ros2Error> {
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
    /// Refuses what is no pose or velocity; gives its time.
    pub(crate) fn check(&self) -> Result<Time, Ros2Error> {
        if let Some(velocity) = &self.velocity {
            check_finite(&self.peer, "a part of the velocity", &velocity.linear)?;
            check_finite(&self.peer, "a part of the angular velocity", &velocity.angular)?;
        }
        self.pose.check(&self.peer)
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
            stamp_utc_ns: 1_700_000_000_000_000_123,
            position: [1.0, -2.0, 0.5],
            // A quarter turn to the left.
            orientation: [0.0, 0.0, 0.5_f64.sqrt(), 0.5_f64.sqrt()],
            covariance: std::array::from_fn(|k| k as f64),
        }
    }

    #[test]
    fn a_pose_is_in_the_observers_frame_and_its_covariance_keeps_its_order() {
        let pose = pose();
        let stamp = pose.check("kite").unwrap();
        let message = pose_message(&pose, stamp, "wren");
        assert_eq!(message.header.frame_id, "wren/base_link");
        assert_eq!((message.header.stamp.sec, message.header.stamp.nanosec), (1_700_000_000, 123));
        assert_eq!(message.pose.covariance[1][3], 9.0);
        assert_eq!(message.pose.pose.position, Point { x: 1.0, y: -2.0, z: 0.5 });
    }

    #[test]
    fn a_transform_has_one_parent_whoever_else_sees_its_target() {
        let pose = pose();
        let message = transform(&pose, Time::default(), "wren", "kite");
        assert_eq!(message.header.frame_id, "wren/base_link");
        assert_eq!(message.child_frame_id, "kite_seen_by_wren");
        assert_eq!(message.transform.rotation, quaternion(pose.orientation));
    }

    #[test]
    fn a_velocity_is_turned_into_the_axes_of_who_moves() {
        let velocity = Velocity { linear: [0.0, 2.0, 0.0], angular: [0.3, 0.0, 0.1] };
        let seen = ObserverSeen { peer: "kite".into(), pose: pose(), velocity: Some(velocity) };
        let message = odometry(&seen, Time::default(), "wren", "kite");
        assert_eq!(message.header.frame_id, "kite/base_link");
        assert_eq!(message.child_frame_id, "wren/base_link");
        // Turned to the left, it flies to the peer's left, which is straight ahead for itself.
        let Twist { linear, angular } = message.twist.twist;
        let near = |found: f64, wanted: f64| assert!((found - wanted).abs() < 1e-12, "{found}");
        near(linear.x, 2.0);
        near(linear.y, 0.0);
        near(angular.y, -0.3);
        near(angular.z, 0.1);
        assert_eq!(message.twist.covariance[5][5], UNKNOWN_VARIANCE);
        assert_eq!(message.twist.covariance[5][4], 0.0);
    }

    #[test]
    fn what_is_no_pose_is_refused_with_its_value() {
        let refused = |change: fn(&mut RelativePose)| {
            let mut pose = pose();
            change(&mut pose);
            pose.check("kite").expect_err("refused").to_string()
        };
        assert!(refused(|pose| pose.position[2] = f64::NAN).contains("position is NaN"));
        assert!(refused(|pose| pose.covariance[35] = f64::INFINITY).contains("covariance is inf"));
        assert!(refused(|pose| pose.covariance[35] = -1.0).contains("variance is -1.0"));
        assert!(refused(|pose| pose.orientation = [0.0; 4]).contains("norm is 0.0"));
        assert!(refused(|pose| pose.stamp_utc_ns = i64::MAX).contains("9223372036854775807 ns"));
        let velocity = Velocity { linear: [0.0; 3], angular: [f64::NAN, 0.0, 0.0] };
        let seen = ObserverSeen { peer: "kite".into(), pose: pose(), velocity: Some(velocity) };
        assert!(seen.check().expect_err("refused").to_string().contains("angular velocity is NaN"));
    }
}
