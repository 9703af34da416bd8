//! The capture stage's process.

use std::process::ExitCode;

fn main() -> ExitCode {
    flockeye_runtime::stage::main::<flockeye_capture::stage::CaptureStage>()
}
