//! Stage: frames and plans to views.
//!
//! | module | what it answers |
//! | --- | --- |
//! | [`rectifier`] | what cuts views |
//! | `backend` | which back end is chosen |
//! | [`cpu`] | views cut by the processor |
//! | [`gpu`] | views cut by the graphics processor |
//! | `job` | which views of a frame are cut, which is next, and when it is enough |
//! | `proposals` | which places that look like a body become views |
//! | `dispatch` | which worker gets the next view, and which views were lost |
//! | `cadence` | when the next frame is due, and what fits before |
//! | `virtual_budget` | what fits into a frame by stated costs, in a lossless run |
//! | `frame_clock` | which of the two decides |
//! | [`core`](mod@core) | all decisions: events in, actions out |
//! | [`cutting`] | cuts and searches of a frame's pixels, also once the back end is lost |
//! | `inbox` | the ports that are read |
//! | `silence_reports` | sources and workers that are silent |
//! | `stage` | moves messages between ports, core and back end |

#![warn(unreachable_pub)]

mod backend;
mod cadence;
pub mod core;
pub mod cpu;
pub mod cutting;
mod dispatch;
mod frame_clock;
pub mod gpu;
mod inbox;
mod job;
mod proposals;
pub mod rectifier;
mod silence_reports;
mod stage;
mod virtual_budget;

pub use virtual_budget::PROPOSAL_WINDOWS;

/// The rectification stage's process. It is here so that it is compiled once, with the library.
pub fn main() -> std::process::ExitCode {
    flockeye_runtime::stage::main::<stage::RectificationStage>()
}
