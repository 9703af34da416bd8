//! The `flockeye-workshop` command.

use std::process::ExitCode;

fn main() -> ExitCode {
    flockeye_runtime::logs::init();
    match flockeye_workshop::commands::run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("flockeye: {error:#}");
            ExitCode::FAILURE
        }
    }
}
