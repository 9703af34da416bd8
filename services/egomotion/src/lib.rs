//! How the camera itself turns, from the sphere that it sees.
//!
//! [`core`] follows the rotation from frame to frame ([`flockeye_imaging::gyroscope`]) and its rate during
//! each exposure ([`rate`]). An inertial sensor adds to both where there is one and it agrees ([`inertial`]).
//! Health says how the camera turns ([`words`]). docs/DETECTION.md describes the method and what it reaches.

pub mod core;
pub mod inertial;
pub mod rate;
mod stage;
pub mod words;

/// The egomotion stage's process. It is here so that it is compiled once, with the library.
pub fn main() -> std::process::ExitCode {
    flockeye_runtime::stage::main::<stage::EgomotionStage>()
}
