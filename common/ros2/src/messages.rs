//! The published ROS 2 messages, and their encoding.
//!
//! The structs have the numbers and texts of ROS 2 Jazzy's types in the same order. The encoding
//! depends only on this. The types are of `std_msgs`, `geometry_msgs`, `nav_msgs` and `tf2_msgs`; a
//! vector or quaternion is an array. The encoding is plain CDR (OMG CORBA 3.4, 9.3), little-endian.
//! It follows the four bytes of a DDS encapsulation header (DDSI-RTPS 2.3, 10.2).

use byteorder::LittleEndian;
use serde::Serialize;

use crate::error::Ros2Error;

/// `CDR_LE`: plain CDR follows, little-endian, without options.
const ENCAPSULATION: [u8; 4] = [0x00, 0x01, 0x00, 0x00];

/// A type of ROS 2 message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum MessageType {
    /// [`PoseWithCovarianceStamped`].
    PoseWithCovarianceStamped,
    /// [`TfMessage`].
    TfMessage,
    /// [`OdometryMessage`].
    Odometry,
}

impl MessageType {
    /// The name in ROS, such as `nav_msgs/msg/Odometry`.
    pub fn ros_name(self) -> &'static str {
        match self {
            Self::PoseWithCovarianceStamped => "geometry_msgs/msg/PoseWithCovarianceStamped",
            Self::TfMessage => "tf2_msgs/msg/TFMessage",
            Self::Odometry => "nav_msgs/msg/Odometry",
        }
    }

    /// The name in DDS, such as `nav_msgs::msg::dds_::Odometry_`, which keys carry.
    pub fn dds_name(self) -> String {
        self.ros_name().replace("/msg/", "::msg::dds_::") + "_"
    }

    /// The hash of the type's description (REP-2011, version RIHS01). Another description of the
    /// type has another hash, and so another key.
    pub fn hash(self) -> &'static str {
        match self {
            Self::PoseWithCovarianceStamped => {
                "RIHS01_26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e"
            }
            Self::TfMessage => {
                "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
            }
            Self::Odometry => {
                "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0"
            }
        }
    }
}

/// A message that can be published or recorded.
pub trait Ros2Message: Serialize + Sized {
    /// Its type.
    const TYPE: MessageType;

    /// The message's bytes, encapsulation header included.
    ///
    /// # Errors
    /// [`Ros2Error::Encode`].
    fn to_cdr(&self) -> Result<Vec<u8>, Ros2Error> {
        let failed = |error: cdr_encoding::Error| Ros2Error::Encode {
            message: Self::TYPE.ros_name(),
            reason: error.to_string(),
        };
        // Alignment is relative to the end of the header, so the body is encoded separately.
        let body = cdr_encoding::to_vec::<_, LittleEndian>(self).map_err(failed)?;
        Ok([&ENCAPSULATION[..], &body].concat())
    }
}

/// `builtin_interfaces/msg/Time`: a time since 1970-01-01 UTC.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Time {
    /// Whole seconds, rounded down.
    pub sec: i32,
    /// Additional nanoseconds, below 1,000,000,000.
    pub nanosec: u32,
}

impl Time {
    /// The time of `utc_ns` nanoseconds since the Unix epoch. `None` outside the years 1901 to
    /// 2038, the range of 32 bits of seconds.
    pub fn from_utc_ns(utc_ns: i64) -> Option<Self> {
        const SECOND_NS: i64 = 1_000_000_000;
        Some(Self {
            sec: i32::try_from(utc_ns.div_euclid(SECOND_NS)).ok()?,
            nanosec: u32::try_from(utc_ns.rem_euclid(SECOND_NS)).ok()?,
        })
    }

    /// Nanoseconds since the Unix epoch.
    pub fn utc_ns(self) -> i64 {
        i64::from(self.sec) * 1_000_000_000 + i64::from(self.nanosec)
    }
}

/// `std_msgs/msg/Header`.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct Header {
    /// Time of the measurement.
    pub stamp: Time,
    /// The frame of its coordinates.
    pub frame_id: String,
}

/// A 6x6 matrix. Row by row it has the bytes of ROS's `float64[36]`.
pub type Matrix6 = [[f64; 6]; 6];

/// `geometry_msgs/msg/PoseWithCovariance`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct PoseWithCovariance {
    /// Position of the origin, metres.
    pub position: [f64; 3],
    /// The rotation into the frame of the header, quaternion x y z w.
    pub orientation: [f64; 4],
    /// Covariance of position (m) and of rotations about the fixed axes (rad) of the header's
    /// frame.
    pub covariance: Matrix6,
}

/// `geometry_msgs/msg/PoseWithCovarianceStamped`.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct PoseWithCovarianceStamped {
    /// Time and frame.
    pub header: Header,
    /// The pose in that frame.
    pub pose: PoseWithCovariance,
}

impl Ros2Message for PoseWithCovarianceStamped {
    const TYPE: MessageType = MessageType::PoseWithCovarianceStamped;
}

/// `geometry_msgs/msg/TransformStamped`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TransformStamped {
    /// Time and parent frame.
    pub header: Header,
    /// The child frame.
    pub child_frame_id: String,
    /// Position of the child's origin in the header's frame, metres.
    pub translation: [f64; 3],
    /// The rotation, header's frame from child, quaternion x y z w.
    pub rotation: [f64; 4],
}

/// `tf2_msgs/msg/TFMessage`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TfMessage {
    /// The transforms.
    pub transforms: Vec<TransformStamped>,
}

impl Ros2Message for TfMessage {
    const TYPE: MessageType = MessageType::TfMessage;
}

/// `nav_msgs/msg/Odometry`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct OdometryMessage {
    /// Time, and the frame of the pose.
    pub header: Header,
    /// The frame of the velocities, whose pose this is.
    pub child_frame_id: String,
    /// Header's frame from child.
    pub pose: PoseWithCovariance,
    /// Linear velocity along the child's axes, m/s.
    pub linear_velocity: [f64; 3],
    /// Angular velocity along the child's axes, rad/s.
    pub angular_velocity: [f64; 3],
    /// Covariance of the velocities, linear then angular.
    pub velocity_covariance: Matrix6,
}

impl Ros2Message for OdometryMessage {
    const TYPE: MessageType = MessageType::Odometry;
}

#[cfg(test)]
mod tests;
