//! Stage: tracks to the swarm over Zenoh, and the peers' reports back.
//!
//! | module | what it does |
//! | --- | --- |
//! | `core` | what becomes of each message |
//! | `frame` | all targets of a frame as one report |
//! | `selection` | which frames are reported where not all are |
//! | `odometry` | where this drone was at an exposure |
//! | `swarm` | where all drones are, as the topics have it |
//! | `in_words` | the peers' state in words for people |
//! | `security_warnings` | links of strangers, and the end of the certificate |
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
