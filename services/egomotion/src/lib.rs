//! How the camera itself turns, from the sphere that it sees.
//!
//! The core follows the rotation from frame to frame ([`flockeye_imaging::gyroscope`]) and its rate
//! during each exposure (`rate`). An inertial sensor adds to both where there is one and it agrees
//! (`inertial`). Health reports how the camera turns (`words`). docs/DETECTION.md describes the
//! method and what it reaches.

#![warn(unreachable_pub)]

mod core;
mod inertial;
mod rate;
mod stage;
mod words;

/// The egomotion stage's process. It is here so that it is compiled once, with the library.
pub fn main() -> std::process::ExitCode {
    flockeye_runtime::stage::main::<stage::EgomotionStage>()
}
