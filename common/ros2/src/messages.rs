//! The ROS 2 messages that are published, and their bytes.
//!
//! The structs are those of ROS 2 Jazzy's `std_msgs`, `geometry_msgs`, `nav_msgs` and `tf2_msgs`, field by
//! field in the same order, which is all that their encoding depends on: plain CDR (OMG CORBA 3.4, 9.3),
//! little-endian, after the four bytes of a DDS encapsulation header (DDSI-RTPS 2.3, 10.2).

use byteorder::LittleEndian;
use serde::Serialize;

use crate::error::Ros2Error;

/// `CDR_LE`: what follows is plain CDR, little-endian; no options.
const ENCAPSULATION: [u8; 4] = [0x00, 0x01, 0x00, 0x00];

/// A type of message, as ROS 2 names it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum MessageType {
    /// [`PoseWithCovarianceStamped`].
    PoseWithCovarianceStamped,
    /// [`TfMessage`].
    TfMessage,
    /// [`Odometry`].
    Odometry,
}

impl MessageType {
    /// The name that users of ROS know, such as `nav_msgs/msg/Odometry`.
    pub fn ros_name(self) -> &'static str {
        match self {
            Self::PoseWithCovarianceStamped => "geometry_msgs/msg/PoseWithCovarianceStamped",
            Self::TfMessage => "tf2_msgs/msg/TFMessage",
            Self::Odometry => "nav_msgs/msg/Odometry",
        }
    }

    /// The name in DDS, such as `nav_msgs::msg::dds_::Odometry_`, which keys carry.
    pub fn dds_name(self) -> &'static str {
        match self {
            Self::PoseWithCovarianceStamped => {
                "geometry_msgs::msg::dds_::PoseWithCovarianceStamped_"
            }
            Self::TfMessage => "tf2_msgs::msg::dds_::TFMessage_",
            Self::Odometry => "nav_msgs::msg::dds_::Odometry_",
        }
    }

    /// The hash of the type's description (REP-2011, version RIHS01). Whoever has another description of
    /// the type has another hash, and so another key.
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
pub trait Message: Serialize + Sized {
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
        // Alignment counts from after the header, so the body is encoded by itself.
        let body = cdr_encoding::to_vec::<_, LittleEndian>(self).map_err(failed)?;
        Ok([&ENCAPSULATION[..], &body].concat())
    }
}

/// `builtin_interfaces/msg/Time`: a time since 1970-01-01 UTC.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Time {
    /// Whole seconds, rounded down.
    pub sec: i32,
    /// Nanoseconds on top, below 1,000,000,000.
    pub nanosec: u32,
}

impl Time {
    /// The time of `utc_ns` nanoseconds since the Unix epoch; `None` outside the years 1901 to 2038, which
    /// is all that 32 bits of seconds hold.
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
    /// When it was measured.
    pub stamp: Time,
    /// The frame in which it is expressed.
    pub frame_id: String,
}

/// `geometry_msgs/msg/Point`, metres.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Point {
    /// Along x, metres.
    pub x: f64,
    /// Along y, metres.
    pub y: f64,
    /// Along z, metres.
    pub z: f64,
}

/// `geometry_msgs/msg/Vector3`: of metres, metres per second or radians per second, as its owner says.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Vector3 {
    /// Along x.
    pub x: f64,
    /// Along y.
    pub y: f64,
    /// Along z.
    pub z: f64,
}

/// `geometry_msgs/msg/Quaternion`: a rotation, of norm 1.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Quaternion {
    /// First imaginary part.
    pub x: f64,
    /// Second imaginary part.
    pub y: f64,
    /// Third imaginary part.
    pub z: f64,
    /// Real part.
    pub w: f64,
}

impl Default for Quaternion {
    fn default() -> Self {
        Self { x: 0.0, y: 0.0, z: 0.0, w: 1.0 }
    }
}

/// `geometry_msgs/msg/Pose`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Pose {
    /// Where the origin is.
    pub position: Point,
    /// The rotation into the frame of the header.
    pub orientation: Quaternion,
}

/// A 6x6 matrix. Row by row it has the bytes of ROS's `float64[36]`.
pub type Matrix6 = [[f64; 6]; 6];

/// `geometry_msgs/msg/PoseWithCovariance`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct PoseWithCovariance {
    /// The pose.
    pub pose: Pose,
    /// Covariance of position (m) and of rotations about the fixed axes (rad) of the header's frame.
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

impl Message for PoseWithCovarianceStamped {
    const TYPE: MessageType = MessageType::PoseWithCovarianceStamped;
}

/// `geometry_msgs/msg/Transform`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Transform {
    /// Where the child's origin is in the header's frame, metres.
    pub translation: Vector3,
    /// The rotation, header's frame from child.
    pub rotation: Quaternion,
}

/// `geometry_msgs/msg/TransformStamped`.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct TransformStamped {
    /// Time and parent frame.
    pub header: Header,
    /// The child frame.
    pub child_frame_id: String,
    /// Parent from child.
    pub transform: Transform,
}

/// `tf2_msgs/msg/TFMessage`.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct TfMessage {
    /// The transforms.
    pub transforms: Vec<TransformStamped>,
}

impl Message for TfMessage {
    const TYPE: MessageType = MessageType::TfMessage;
}

/// `geometry_msgs/msg/Twist`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Twist {
    /// m/s.
    pub linear: Vector3,
    /// rad/s.
    pub angular: Vector3,
}

/// `geometry_msgs/msg/TwistWithCovariance`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct TwistWithCovariance {
    /// The velocities.
    pub twist: Twist,
    /// Their covariance, linear then angular.
    pub covariance: Matrix6,
}

/// `nav_msgs/msg/Odometry`.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Odometry {
    /// Time, and the frame of the pose.
    pub header: Header,
    /// The frame of the twist, and whose pose it is.
    pub child_frame_id: String,
    /// Header's frame from child.
    pub pose: PoseWithCovariance,
    /// Velocities along the child's axes.
    pub twist: TwistWithCovariance,
}

impl Message for Odometry {
    const TYPE: MessageType = MessageType::Odometry;
}

#[cfg(test)]
mod tests;
