//! The `flockeye-viewer` command: `flockeye view`.

use std::process::ExitCode;

fn main() -> ExitCode {
    flockeye_runtime::logs::init();
    match flockeye_viewer::program::run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("flockeye: {error:#}");
            ExitCode::FAILURE
        }
    }
}
