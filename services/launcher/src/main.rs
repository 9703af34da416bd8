//! The `flockeye` command.

use std::process::ExitCode;

use clap::Parser;
use flockeye_launcher::cli::{Calibrate, Command, Flockeye};
use flockeye_launcher::{
    calibrate, check, clean, evaluation, exec, experiment, markers, partition, peers, schema, top,
    trace, up,
};

fn main() -> ExitCode {
    flockeye_runtime::logs::init();
    let outcome = match Flockeye::parse().command {
        Command::Up(arguments) => up::run(&arguments),
        Command::Check(arguments) => check::run(&arguments),
        Command::Top(arguments) => top::run(&arguments),
        Command::Trace(arguments) => trace::run(&arguments),
        Command::Peers(arguments) => peers::run(&arguments),
        Command::Eval(arguments) => evaluation::run(&arguments),
        Command::Experiment(arguments) => experiment::run(&arguments),
        Command::Partition(arguments) => partition::run(&arguments),
        Command::Markers(arguments) => markers::run(&arguments),
        Command::Calibrate(Calibrate::Body(arguments)) => calibrate::run(&arguments),
        Command::Clean(arguments) => clean::run(&arguments),
        Command::Schema => schema::run(),
        Command::ExecStage(arguments) => exec::run(&arguments),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("flockeye: {error:#}");
            ExitCode::FAILURE
        }
    }
}
