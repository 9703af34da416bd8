//! Stage: sends tracks to the drone's autopilot, and publishes its odometry.
//!
//! | module | what it does |
//! | --- | --- |
//! | `core` | conversion of tracks for the autopilot, and of odometry for the contract |
//! | `stage` | the ports, and the line of `flockeye-autopilot` |
//!
//! It is an onlooker: it reads `track`, and no other stage waits for it. The gateway reads its
//! `odometry`, and reports frames without it where it is missing.

mod core;
mod stage;

/// The autopilot stage's process. It is here so that it is compiled once, with the library.
pub fn main() -> std::process::ExitCode {
    flockeye_runtime::stage::main::<stage::AutopilotStage>()
}
