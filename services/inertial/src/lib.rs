//! An autopilot's inertial sensor, over MAVLink.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`autopilot`] | the connection: asks for samples, receives them, opens a lost line again |
//! | `message` | which MAVLink messages are samples, along Flockeye's axes |
//! | `sensor_clock` | the autopilot's time on this machine's clock |
//! | `core` | which of the samples go out |
//! | `line_activity` | whether samples come |
//! | `stage` | the port |
//!
//! Whether the samples are right is egomotion's to judge, by the picture.

#![warn(unreachable_pub)]

pub mod autopilot;
mod core;
mod line_activity;
mod message;
mod sensor_clock;
mod stage;

/// The inertial stage's process. It is here so that it is compiled once, with the library.
pub fn main() -> std::process::ExitCode {
    flockeye_runtime::stage::main::<stage::InertialStage>()
}
