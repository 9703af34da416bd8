//! Stage: tracks and peers' sightings to ROS 2.
//!
//! | module | what it does |
//! | --- | --- |
//! | `core` | which tracks and sightings are published, and as what |
//! | `stage` | the ports, and the node of `flockeye-ros2` |
//!
//! It is an onlooker: it reads `track` and `peer`, and no other stage waits for it. So a router
//! that is not there, or a process that dies, touches neither the swarm nor the frames.

mod core;
mod stage;

/// The ROS 2 stage's process. It is here so that it is compiled once, with the library.
pub fn main() -> std::process::ExitCode {
    flockeye_runtime::stage::main::<stage::Ros2Stage>()
}
