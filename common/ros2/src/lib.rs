//! A drone's neighbours as ROS 2 messages, without ROS installed.
//!
//! [`Ros2Node`] appears in ROS 2 as a node. It publishes over Zenoh in the same format as the ROS
//! middleware `rmw_zenoh_cpp` of ROS 2 Jazzy (0.2.4) and later:
//!
//! | topic | message |
//! | --- | --- |
//! | `/<observer>/neighbours/<target>/pose` | `geometry_msgs/msg/PoseWithCovarianceStamped` |
//! | `/tf` | `tf2_msgs/msg/TFMessage` |
//! | `/<observer>/seen_by/<peer>/odometry` | `nav_msgs/msg/Odometry` |
//!
//! ```no_run
//! use flockeye_ros2::{RelativePose, Ros2Node, Ros2Parameters};
//!
//! let node = Ros2Node::open(&Ros2Parameters::default(), "wren")?;
//! let kite = RelativePose {
//!     name: "kite".into(),
//!     stamp_utc_ns: 1_700_000_000_000_000_000,
//!     position: [1.0, -2.0, 0.5],
//!     orientation: [0.0, 0.0, 0.0, 1.0],
//!     covariance: [0.0; 36],
//! };
//! node.publish_neighbour(&kite)?;
//! node.publish_transforms(&[kite])?;
//! # Ok::<(), flockeye_ros2::Ros2Error>(())
//! ```
//!
//! - [`messages`]: the messages and their CDR bytes. The module does not depend on Zenoh, so
//!   recordings can use it.
//! - [`keys`]: keys under which rmw_zenoh publishes and announces, and its attachments.
//! - [`Ros2Parameters`]: parameters of the link to the ROS nodes.
//!
//! `docs/PEERS.md` describes the topics, frames and limits for users.

pub mod keys;
pub mod messages;

mod error;
mod names;
mod node;
mod parameters;
mod pose;
mod session;

pub use error::Ros2Error;
pub use names::{TRANSFORMS, pose_topic, ros_name};
pub use node::Ros2Node;
pub use parameters::Ros2Parameters;
pub use pose::{ObserverSeen, RelativePose, UNKNOWN_VARIANCE};
