//! The `flockeye` command.

use std::process::ExitCode;

use flockeye_launcher::{commands, lab};

fn main() -> ExitCode {
    flockeye_runtime::logs::init();
    let arguments: Vec<_> = std::env::args_os().skip(1).collect();
    let outcome = if lab::is_asked_for(&arguments) {
        lab::become_lab(&arguments)
    } else if let Some((passed, rest)) = lab::passed_on(&arguments) {
        lab::become_program(passed.program, passed.typed, &rest)
    } else {
        commands::run()
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("flockeye: {error:#}");
            ExitCode::FAILURE
        }
    }
}
