//! Stage: tracks to the drone's autopilot, and its odometry back.
//!
//! | module | what it does |
//! | --- | --- |
//! | `core` | which tracks are sent, and odometry as the contract has it |
//! | `stage` | the ports, and the line of `flockeye-autopilot` |
//!
//! It is an onlooker: it reads `track`, and no other stage waits for it. The gateway reads its
//! `odometry`, and reports frames without it where none comes.

mod core;
mod stage;

/// The autopilot stage's process. It is here so that it is compiled once, with the library.
pub fn main() -> std::process::ExitCode {
    flockeye_runtime::stage::main::<stage::AutopilotStage>()
}
