//! Errors of publishing to ROS 2.

use flockeye_network::NetworkError;

/// Maximum targets, and maximum peers, of a node.
pub(crate) const MAX_DRONES: usize = 64;

/// Errors of publishing to ROS 2. None of them ends a stage that is already running.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the texts name the fields")]
pub enum Ros2Error {
    /// An invalid parameter, or a session or thread that cannot be started.
    #[error(transparent)]
    Network(#[from] NetworkError),
    /// An invalid name of another drone.
    #[error("drone '{name}' {reason}")]
    Name { name: String, reason: &'static str },
    /// Two drones that would have the same name in ROS.
    #[error(
        "drone '{name}' and drone '{other}' would both be '{ros_name}' in ROS. Cure: give one of them a \
         name that differs in letters or digits"
    )]
    Collision { name: String, other: String, ros_name: String },
    /// More drones than the maximum.
    #[error("drone '{0}': already {MAX_DRONES} drones, which is the most")]
    TooManyDrones(String),
    /// An invalid pose.
    #[error("pose of or by '{name}': {what} is {found:?}, which {reason}")]
    Pose { name: String, what: &'static str, found: f64, reason: &'static str },
    /// A time that ROS cannot express.
    #[error("pose of or by '{name}': {stamp_utc_ns} ns is outside the years 1901 to 2038 of ROS")]
    Stamp { name: String, stamp_utc_ns: i64 },
    /// A message that cannot be encoded, such as one with a text of gigabytes.
    #[error("cannot encode a {message}: {reason}")]
    Encode { message: &'static str, reason: String },
    /// The session at the other end is no router and passes nothing on.
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
