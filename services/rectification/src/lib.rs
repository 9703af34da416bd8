//! Stage: frames and plans to views.
//!
//! | module | purpose |
//! | --- | --- |
//! | [`rectifier`] | the interface of the back ends |
//! | `backend` | choice of the back end |
//! | [`cpu`] | the CPU back end |
//! | [`gpu`] | the GPU back end |
//! | `job` | views of one frame: order, state and end |
//! | `proposals` | choice of places that resemble a body |
//! | `dispatch` | distribution of views to workers, and lost views |
//! | `cadence` | prediction of the next frame's arrival |
//! | `virtual_budget` | time budget by configured costs, in a lossless run |
//! | `frame_clock` | the time budget that applies |
//! | [`core`](mod@core) | all decisions: events in, actions out |
//! | [`cutting`] | cuts and proposal searches, with the CPU as fallback |
//! | `inbox` | the input ports |
//! | `silence_reports` | timeouts of sources and workers |
//! | `stage` | messages between ports, core and back end |

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

/// The rectification stage's process. It is part of the library, so that it is compiled once.
pub fn main() -> std::process::ExitCode {
    flockeye_runtime::stage::main::<stage::RectificationStage>()
}
