//! Stage: sends tracks to the swarm over Zenoh, and receives the peers' reports.
//!
//! | module | what it does |
//! | --- | --- |
//! | `core` | processing of each message |
//! | `frame` | all targets of a frame as one report |
//! | `selection` | selection of the reported frames, where the rate is limited |
//! | `odometry` | this drone's pose at an exposure |
//! | `swarm` | conversion of poses and sightings to the topics' formats |
//! | `in_words` | the peers' state as a text for people |
//! | `security_warnings` | warnings about refused links and the certificate's expiry |
//! | `link` | the session |
//! | `stage` | the ports around it |

mod core;
mod frame;
mod in_words;
mod link;
mod odometry;
mod security_warnings;
mod selection;
mod stage;
mod swarm;

/// The gateway stage's process. It is here so that it is compiled once, with the library.
pub fn main() -> std::process::ExitCode {
    flockeye_runtime::stage::main::<stage::GatewayStage>()
}
