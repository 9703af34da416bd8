//! Stage: frames and plans to views.
//!
//! | module | what it answers |
//! | --- | --- |
//! | [`rectifier`] | what cuts views |
//! | [`backend`] | which back end is chosen |
//! | [`cpu`] | views cut by the processor |
//! | [`gpu`] | views cut by the graphics processor |
//! | [`standby`] | the processor in place of a graphics processor that was lost |
//! | [`job`] | which views of a frame are cut, which is next, and when it is enough |
//! | [`proposing`] | which places that look like a body are looked at |
//! | [`dispatch`] | which worker gets the next view, and which views were lost |
//! | [`cadence`] | when the next frame is due, and what fits before |
//! | [`virtual_budget`] | what fits into a frame by stated costs, in a lossless run |
//! | [`frame_clock`] | which of the two decides |
//! | [`core`] | all decisions: events in, orders out |
//! | [`cutting`] | a view cut by a back end, as a message |
//! | [`inbox`] | the ports that are read |
//! | [`stage`] | moves messages between ports, core and back end |

pub mod backend;
pub mod cadence;
pub mod core;
pub mod cpu;
pub mod cutting;
pub mod dispatch;
pub mod frame_clock;
pub mod gpu;
pub mod inbox;
pub mod job;
pub mod proposing;
pub mod rectifier;
pub mod stage;
pub mod standby;
pub mod virtual_budget;

/// The rectification stage's process. It is here so that it is compiled once, with the library.
pub fn main() -> std::process::ExitCode {
    flockeye_runtime::stage::main::<stage::RectificationStage>()
}
