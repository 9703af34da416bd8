//! The channels of a recording: their names, and what their messages are.

use flockeye_ros2::messages::MessageType;
use flockeye_ros2::{TRANSFORMS, pose_topic};

use crate::definition;
use crate::layout::TopicLayout;

/// A channel.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct ChannelKind {
    /// Its name.
    pub topic: String,
    /// The name of its messages.
    pub message: String,
    /// Their definition, with all that it needs.
    pub definition: String,
}

/// Pixels of views, on a channel of its own beside that of the views' headers. Both have the same sequence
/// numbers.
pub const VIEW_IMAGES: &str = "/flockeye/view/image";
/// Pictures of frames. Each stands behind its header.
pub const FRAME_IMAGES: &str = "/flockeye/frame/image";
/// The camera's own packets. Each stands behind its header.
pub const FRAME_VIDEO: &str = "/flockeye/frame/video";
/// What the recording lacks.
pub const LOSSES: &str = "/flockeye/recording/loss";

impl ChannelKind {
    /// The channel of a topic of the contract.
    pub fn of_topic(layout: &TopicLayout) -> Self {
        Self {
            topic: layout.channel(),
            message: layout.message_name(),
            definition: definition::of_topic(layout),
        }
    }

    /// The channel of a neighbour's poses. Both names are those in ROS.
    pub fn of_poses(observer: &str, target: &str) -> Self {
        Self {
            topic: pose_topic(&format!("/{observer}"), target),
            message: MessageType::PoseWithCovarianceStamped.ros_name().to_owned(),
            definition: definition::POSE.to_owned(),
        }
    }

    /// The channel of all transforms.
    pub fn of_transforms() -> Self {
        Self {
            topic: TRANSFORMS.to_owned(),
            message: MessageType::TfMessage.ros_name().to_owned(),
            definition: definition::TRANSFORMS.to_owned(),
        }
    }

    /// The channel of views, pixels as they are.
    pub fn of_view_images() -> Self {
        Self {
            topic: VIEW_IMAGES.to_owned(),
            message: "sensor_msgs/msg/Image".to_owned(),
            definition: definition::IMAGE.to_owned(),
        }
    }

    /// The channel of compressed frames.
    pub fn of_frame_images() -> Self {
        Self {
            topic: FRAME_IMAGES.to_owned(),
            message: "sensor_msgs/msg/CompressedImage".to_owned(),
            definition: definition::COMPRESSED_IMAGE.to_owned(),
        }
    }

    /// The channel of a camera's own packets.
    pub fn of_frame_video() -> Self {
        Self {
            topic: FRAME_VIDEO.to_owned(),
            message: "foxglove_msgs/msg/CompressedVideo".to_owned(),
            definition: definition::COMPRESSED_VIDEO.to_owned(),
        }
    }

    /// The channel of losses: what the recording lacks.
    pub fn of_losses() -> Self {
        Self {
            topic: LOSSES.to_owned(),
            message: "flockeye_msgs/msg/Loss".to_owned(),
            definition: definition::LOSS.to_owned(),
        }
    }
}
