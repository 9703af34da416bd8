//! The detection stage's process.

use std::process::ExitCode;

fn main() -> ExitCode {
    flockeye_runtime::stage::main::<flockeye_detection::stage::DetectionStage>()
}
