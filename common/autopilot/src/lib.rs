//! The line to the drone's autopilot (PX4, ArduPilot) over MAVLink 2: it sends neighbours, and
//! receives the drone's motion.
//!
//! ```no_run
//! use flockeye_autopilot::{AutopilotLine, NeighbourState};
//! use flockeye_config::Autopilot;
//! use nalgebra::{Isometry3, Matrix6};
//!
//! let autopilot = AutopilotLine::open(&Autopilot {
//!     link: "serial:/dev/ttyACM0:921600".into(),
//!     target: Some("kite".into()),
//!     ..Autopilot::default()
//! })?;
//! let exposure_monotonic_ns = 1_000_000_000;
//! autopilot.neighbour(&NeighbourState {
//!     name: "kite".into(),
//!     observer_from_target: Isometry3::translation(2.0, 1.0, 0.5),
//!     covariance: Matrix6::identity() * 0.01,
//!     exposure_monotonic_ns,
//!     is_lost: false,
//! })?;
//! if let Some(state) = autopilot.take_odometry() {
//!     println!("the drone is at {}", state.odometry.odom_from_base);
//! }
//! # Ok::<(), flockeye_autopilot::AutopilotError>(())
//! ```
//!
//! Sent messages: `TARGET_RELATIVE` for one neighbour, `OBSTACLE_DISTANCE_3D` for all, `HEARTBEAT`,
//! `TIMESYNC`. Received messages: `TIMESYNC`, `ODOMETRY`, `LOCAL_POSITION_NED`,
//! `ATTITUDE_QUATERNION`.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`core`] | timing of sent messages, and state from received ones; no line, thread or clock |
//! | [`messages`] | states as MAVLink messages |
//! | `timesync` | the offset of the autopilot's clock |
//! | `odometry` | the drone's motion |
//! | `neighbours` | the newest state of each neighbour |
//! | `pace` | rate limits |
//! | `axes` | conversions between the axes of MAVLink and REP-103 |
//! | [`link`] | the line: UDP or serial |
//!
//! `docs/AUTOPILOT.md` describes the line for users.

mod axes;
pub mod core;
pub mod link;
pub mod messages;
mod neighbours;
mod odometry;
mod pace;
mod timesync;

mod autopilot;
mod error;
mod neighbour;

pub use autopilot::{AutopilotLine, AutopilotStatus};
pub use error::AutopilotError;
pub use neighbour::NeighbourState;
pub use odometry::{OdometryAt, OdometryFrame, OdometryState};
pub use timesync::TimeOffset;
