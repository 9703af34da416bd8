//! Stage: tracks to Zenoh, and the peers' reports back.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`frame`] | all targets of a frame as one report |
//! | [`swarm`] | where all drones are from here, by what peers report too |
//! | [`pilot`] | what the autopilot is told, and what it says of the drone |
//! | [`ros`] | what ROS 2 nodes are told |
//! | [`newest`] | what was said of each neighbour last |
//! | [`hearsay`] | what the peers say, in words for people |
//! | [`guard`] | strangers at the door, and the certificate's end |
//! | [`stage`] | the ports around it |

pub mod frame;
pub mod guard;
pub mod hearsay;
pub mod newest;
pub mod pace;
pub mod pilot;
pub mod ros;
pub mod stage;
pub mod swarm;

/// The gateway stage's process. It is here so that it is compiled once, with the library.
pub fn main() -> std::process::ExitCode {
    flockeye_runtime::stage::main::<stage::GatewayStage>()
}
