//! The channels of a recording: their names and message types.

use flockeye_ros2::messages::MessageType;
use flockeye_ros2::{TRANSFORMS, pose_topic};

use crate::definition;
use crate::layout::TopicLayout;

/// A channel.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct ChannelKind {
    /// The channel's name.
    pub topic: String,
    /// The name of the message type.
    pub message: String,
    /// The definition of the message type, with the types that it contains.
    pub definition: String,
}

/// Pixels of views, on a channel of its own beside that of the views' headers. Both have the same
/// sequence numbers.
pub const VIEW_IMAGES: &str = "/flockeye/view/image";
/// Pictures of frames. Each follows its header in the file.
pub const FRAME_IMAGES: &str = "/flockeye/frame/image";
/// Compressed packets from the camera. Each follows its header in the file.
pub const FRAME_VIDEO: &str = "/flockeye/frame/video";
/// Messages that are missing in the recording.
pub const LOSSES: &str = "/flockeye/recording/loss";

impl ChannelKind {
    fn new(topic: &str, message: &str, definition: &str) -> Self {
        let [topic, message, definition] = [topic, message, definition].map(str::to_owned);
        Self { topic, message, definition }
    }

    /// The channel of a topic of the contract.
    pub fn of_topic(layout: &TopicLayout) -> Self {
        Self {
            topic: layout.channel(),
            message: layout.message_name(),
            definition: definition::of_topic(layout),
        }
    }

    /// The channel of a neighbour's poses. Channel and type have the names that they have in ROS.
    pub fn of_poses(observer: &str, target: &str) -> Self {
        let topic = pose_topic(&format!("/{observer}"), target);
        Self::new(&topic, MessageType::PoseWithCovarianceStamped.ros_name(), definition::POSE)
    }

    /// The channel of all transforms.
    pub fn of_transforms() -> Self {
        Self::new(TRANSFORMS, MessageType::TfMessage.ros_name(), definition::TRANSFORMS)
    }

    /// The channel of views, with uncompressed pixels.
    pub fn of_view_images() -> Self {
        Self::new(VIEW_IMAGES, "sensor_msgs/msg/Image", definition::IMAGE)
    }

    /// The channel of compressed frames.
    pub fn of_frame_images() -> Self {
        Self::new(FRAME_IMAGES, "sensor_msgs/msg/CompressedImage", definition::COMPRESSED_IMAGE)
    }

    /// The channel of compressed packets from the camera.
    pub fn of_frame_video() -> Self {
        Self::new(FRAME_VIDEO, "foxglove_msgs/msg/CompressedVideo", definition::COMPRESSED_VIDEO)
    }

    /// The channel of losses: messages that are missing in the recording.
    pub fn of_losses() -> Self {
        Self::new(LOSSES, "flockeye_msgs/msg/Loss", definition::LOSS)
    }
}
