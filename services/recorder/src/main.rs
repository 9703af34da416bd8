//! The recorder's process.

use std::process::ExitCode;

fn main() -> ExitCode {
    flockeye_runtime::logs::init();
    match flockeye_recorder::run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("flockeye record: {error:#}");
            ExitCode::FAILURE
        }
    }
}
