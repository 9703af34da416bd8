//! An autopilot's inertial sensor, over MAVLink.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`autopilot`] | the connection: requests samples, receives them, reopens a lost line |
//! | `message` | which MAVLink messages are samples, along Flockeye's axes |
//! | `sensor_clock` | the autopilot's time on this machine's clock |
//! | `core` | which of the samples are published |
//! | `line_activity` | whether samples arrive |
//! | `stage` | the port |
//!
//! Egomotion checks the samples against the picture.

pub mod autopilot;
mod core;
mod line_activity;
mod message;
mod sensor_clock;
mod stage;

/// Entry point of the inertial process, in the library so that it is compiled once.
pub fn main() -> std::process::ExitCode {
    flockeye_runtime::stage::main::<stage::InertialStage>()
}
