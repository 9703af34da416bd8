//! The fusion stage's process.

use std::process::ExitCode;

fn main() -> ExitCode {
    flockeye_runtime::stage::main::<flockeye_fusion::stage::FusionStage>()
}
