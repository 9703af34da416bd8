//! What can go wrong with publishing to ROS 2.

use flockeye_network::NetworkError;

/// Maximum targets, and maximum peers, of a node.
pub(crate) const MAX_DRONES: usize = 64;

/// What can go wrong with publishing to ROS 2. None of these ends a stage that is already running.
#[derive(Debug, thiserror::Error)]
pub enum Ros2Error {
    /// A parameter that cannot work, a session or a thread that cannot be had.
    #[error(transparent)]
    Network(#[from] NetworkError),
    /// A name that no other drone can have.
    #[error("drone '{name}' {reason}")]
    Name {
        /// The name.
        name: String,
        /// Why it cannot be published.
        reason: &'static str,
    },
    /// Two drones that would be one in ROS.
    #[error(
        "drone '{name}' and drone '{other}' would both be '{ros_name}' in ROS. Cure: give one of them a \
         name that differs in letters or digits"
    )]
    Collision {
        /// The drone that is refused.
        name: String,
        /// The drone that has the name in ROS already.
        other: String,
        /// The name that both would have.
        ros_name: String,
    },
    /// More drones than there are topics for.
    #[error("drone '{0}': already {MAX_DRONES} drones, which is the most")]
    TooManyDrones(String),
    /// A pose that is none.
    #[error("pose of or by '{name}': {what} is {found:?}, which {reason}")]
    Pose {
        /// The other drone's name.
        name: String,
        /// Which value.
        what: &'static str,
        /// The value.
        found: f64,
        /// Why it cannot be.
        reason: &'static str,
    },
    /// A time that ROS cannot express.
    #[error("pose of or by '{name}': {stamp_utc_ns} ns is outside the years 1901 to 2038 of ROS")]
    Stamp {
        /// The other drone's name.
        name: String,
        /// Nanoseconds since the Unix epoch.
        stamp_utc_ns: i64,
    },
    /// A message that cannot be encoded, such as one with a text of gigabytes.
    #[error("cannot encode a {message}: {reason}")]
    Encode {
        /// The message's type.
        message: &'static str,
        /// What the encoder says.
        reason: String,
    },
    /// A client is linked with a session that passes nothing on.
    #[error(
        "who answers is no router. Cure: start one (ros2 run rmw_zenoh_cpp rmw_zenohd) and name its \
         address in connect. Flockeye's gateway listens on port 7447 too, unless gateway.listen \
         names another"
    )]
    NoRouter,
    /// The session is over.
    #[error("the ROS 2 session is closed")]
    Closed,
}
