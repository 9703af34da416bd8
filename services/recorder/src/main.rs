//! The recorder's process.

use std::process::ExitCode;

use flockeye_recorder::inputs::NotCoded;

fn main() -> ExitCode {
    flockeye_runtime::logs::init();
    match flockeye_recorder::run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("flockeye record: {error:#}");
            // Exit code as for a stage: a retry is useless.
            match error.is::<NotCoded>() {
                true => ExitCode::from(2),
                false => ExitCode::FAILURE,
            }
        }
    }
}
