//! The gateway stage's process.

use std::process::ExitCode;

fn main() -> ExitCode {
    flockeye_runtime::stage::main::<flockeye_gateway::stage::GatewayStage>()
}
