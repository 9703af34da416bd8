//! Stage: tracks to the swarm over Zenoh, and the peers' reports back.
//!
//! | module | what it does |
//! | --- | --- |
//! | `core` | what becomes of each message |
//! | `frame` | all targets of a frame as one report |
//! | `pace` | which frames are reported where not all are |
//! | `odometry` | where this drone was at an exposure |
//! | `swarm` | where all drones are from here, by the peers' reports too |
//! | `in_words` | the peers' state in words for people |
//! | `guard` | links of strangers, and the end of the certificate |
//! | `link` | the session |
//! | `stage` | the ports around it |

mod core;
mod frame;
mod guard;
mod in_words;
mod link;
mod odometry;
mod pace;
mod stage;
mod swarm;

/// The gateway stage's process. It is here so that it is compiled once, with the library.
pub fn main() -> std::process::ExitCode {
    flockeye_runtime::stage::main::<stage::GatewayStage>()
}
