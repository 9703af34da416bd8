//! The camera's own rotation, from the sphere image.
//!
//! The core follows the rotation from frame to frame ([`flockeye_imaging::gyroscope`]) and its rate
//! during each exposure (`rate`). An inertial sensor improves both if there is one and it passes
//! its comparison (`inertial`). Health reports the rotation (`words`). docs/DETECTION.md describes
//! the method and its accuracy.

mod core;
mod inertial;
mod rate;
mod stage;
mod words;

/// Entry point of the egomotion process, in the library so that it is compiled once.
pub fn main() -> std::process::ExitCode {
    flockeye_runtime::stage::main::<stage::EgomotionStage>()
}
