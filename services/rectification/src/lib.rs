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
//! | [`dispatch`] | which worker gets the next view, and which views were lost |
//! | [`cadence`] | when the next frame is due, and what fits before |
//! | [`stage`] | the ports around it |

pub mod backend;
pub mod cadence;
pub mod cpu;
pub mod dispatch;
pub mod gpu;
pub mod job;
pub mod rectifier;
pub mod stage;
pub mod standby;

/// The rectification stage's process. It is here so that it is compiled once, with the library.
pub fn main() -> std::process::ExitCode {
    flockeye_runtime::stage::main::<stage::RectificationStage>()
}
