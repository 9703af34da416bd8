//! The command line.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::{CommandFactory, Parser, ValueEnum};
use flockeye_cli::replay::{EXPLAIN, PROGRAM, REPLAY};

use crate::explain::asked::ExplainArguments;
use crate::{explain, replay};

// The descriptions are in `flockeye_cli::replay`, because the help of `flockeye` shows them too.
/// Replays stages of recorded flights, and explains what they decided.
#[derive(Debug, Parser)]
#[command(name = PROGRAM, version)]
enum ReplayCommand {
    #[command(about = REPLAY.about)]
    Replay {
        /// A recording with its views, from the first frame on: recording.folder, with
        /// recording.frames: views.
        #[arg(value_name = "FILE.mcap")]
        file: PathBuf,
        /// The stage.
        #[arg(long, value_enum, default_value_t = ReplayedStage::Fusion)]
        stage: ReplayedStage,
    },
    #[command(about = EXPLAIN.about)]
    Explain(ExplainArguments),
}

/// A stage that can be replayed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum ReplayedStage {
    /// Fusion: from views, detections, rotations and frame ends to tracks and plans.
    Fusion,
}

/// Parses the command line and runs the command. A replay with a difference fails.
pub fn run() -> ExitCode {
    let (command, outcome) = match ReplayCommand::parse() {
        ReplayCommand::Replay { file, stage: ReplayedStage::Fusion } => {
            (REPLAY, replay::report(&file))
        }
        ReplayCommand::Explain(arguments) => (EXPLAIN, explain::main(&arguments).map(|()| true)),
    };
    match outcome {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(error) => {
            eprintln!("flockeye {}: {error:#}", command.name);
            ExitCode::FAILURE
        }
    }
}

/// The command line.
pub fn command() -> clap::Command {
    ReplayCommand::command()
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockeye_cli::replay::COMMANDS;

    #[test]
    fn the_command_line_is_well_formed() {
        command().debug_assert();
        let parse = |words: &[&str]| ReplayCommand::try_parse_from([&["flockeye"], words].concat());
        assert!(parse(&["replay", "a.mcap", "--stage", "fusion"]).is_ok());
        assert!(parse(&["replay"]).is_err());
        assert!(parse(&["replay", "a.mcap", "--stage", "gateway"]).is_err());
    }

    #[test]
    fn flockeye_knows_every_command() {
        let command = command();
        let own: Vec<_> = command.get_subcommands().collect();
        assert_eq!(own.len(), COMMANDS.len());
        for (own, wanted) in own.into_iter().zip(COMMANDS) {
            assert_eq!(own.get_name(), wanted.name);
            assert_eq!(own.get_about().cloned(), Some(wanted.about.into()));
        }
    }
}
