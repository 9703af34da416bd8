//! The line to the drone's autopilot (PX4, ArduPilot) over MAVLink 2: neighbours go out, the
//! drone's motion comes in.
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
//! What goes out: `TARGET_RELATIVE` for one neighbour, `OBSTACLE_DISTANCE_3D` for all, `HEARTBEAT`,
//! `TIMESYNC`. What comes in: `TIMESYNC`, `ODOMETRY`, `LOCAL_POSITION_NED`, `ATTITUDE_QUATERNION`.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`core`] | what is sent when, and what received messages change; without line, thread and clock |
//! | [`messages`] | states as MAVLink messages |
//! | `timesync` | the autopilot's clock |
//! | `odometry` | how the drone moves |
//! | `neighbours` | the newest state of each neighbour |
//! | `pace` | rates that are held |
//! | `axes` | between the axes of MAVLink and REP-103 |
//! | [`link`] | the line: UDP or serial |
//!
//! `docs/AUTOPILOT.md` describes it for users.

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
