//! Stage: publishes tracks and peers' sightings to ROS 2.
//!
//! | module | what it does |
//! | --- | --- |
//! | `core` | selection and conversion of the published tracks and sightings |
//! | `stage` | the ports, and the node of `flockeye-ros2` |
//!
//! It is an onlooker: it reads `track` and `peer`, and no other stage waits for it. So a missing
//! router or a crash of this process affects neither the swarm nor the frames.

mod core;
mod stage;

/// The ROS 2 stage's process. It is here so that it is compiled once, with the library.
pub fn main() -> std::process::ExitCode {
    flockeye_runtime::stage::main::<stage::Ros2Stage>()
}
