//! The command line.

use std::path::PathBuf;
use std::time::Duration;

use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
use flockeye_cli::running::PipelineChoice;
use flockeye_cli::{Configuration, Screen, duration, lab, replay, workshop};

use crate::control::{ControlRequest, WorkerName};
use crate::exec::{self, ExecArguments};
use crate::keys::{self, KeysCommand};
use crate::manage::{self, SwapArguments};
use crate::other_programs;
use crate::peers::{self, PeersArguments};
use crate::run_log::RunOptions;
use crate::top::{self, TopArguments};
use crate::{bodies, check, clean, doctor, trace, up};

/// Eyes for a flock: neighbours' poses from a spherical camera.
#[derive(Debug, Parser)]
#[command(name = "flockeye", version)]
struct Flockeye {
    /// What to do.
    #[command(subcommand)]
    command: FlockeyeCommand,
}

/// All commands but those of the lab. A command without arguments here may have some in another
/// program, which does it.
#[derive(Debug, Subcommand)]
enum FlockeyeCommand {
    /// Run a pipeline until its source ends, or until Ctrl-C.
    Up {
        #[command(flatten)]
        configuration: Configuration,
        #[command(flatten)]
        options: RunOptions,
    },
    /// Check a configuration, and say what it means on this machine.
    Check {
        #[command(flatten)]
        configuration: Configuration,
        /// Run it for this long, and say how soon an untracked target is found on this machine.
        #[arg(long, value_name = "DURATION", value_parser = duration)]
        measure: Option<Duration>,
    },
    /// Look for everything on this machine that could keep it from flying, and say what to do about
    /// it.
    Doctor {
        #[command(flatten)]
        configuration: Configuration,
        /// Print what is found as JSON.
        #[arg(long)]
        json: bool,
    },
    /// Show a running pipeline's processes.
    Status {
        #[command(flatten)]
        running: PipelineChoice,
        /// JSON.
        #[arg(long)]
        json: bool,
    },
    /// Replace a stage's process in flight by another one, so that no frame is lost.
    Swap(SwapArguments),
    /// End a stage of a running pipeline, or the whole pipeline.
    Stop {
        /// The stage, or one worker of it: detection.1. Without it: the whole pipeline.
        #[arg(value_name = "STAGE[.REPLICA]")]
        worker: Option<WorkerName>,
        #[command(flatten)]
        running: PipelineChoice,
    },
    /// Start a stage of a running pipeline that was ended.
    Start {
        /// The stage, or one worker of it: detection.1.
        #[arg(value_name = "STAGE[.REPLICA]")]
        worker: WorkerName,
        #[command(flatten)]
        running: PipelineChoice,
    },
    /// End a stage of a running pipeline, and start it again.
    Restart {
        /// The stage, or one worker of it: detection.1.
        #[arg(value_name = "STAGE[.REPLICA]")]
        worker: WorkerName,
        #[command(flatten)]
        running: PipelineChoice,
    },
    #[command(about = workshop::CHAOS.about)]
    Chaos,
    /// Show what a running pipeline's stages do, and how old its poses are.
    Top(TopArguments),
    /// Show what a running pipeline sees, on a page in the browser.
    View,
    /// Record the path of frames through a running pipeline, for Perfetto (ui.perfetto.dev).
    Trace {
        #[command(flatten)]
        running: PipelineChoice,
        /// The trace, in Chrome's JSON format.
        #[arg(long, value_name = "FILE.json")]
        out: PathBuf,
        /// How long to record: 10s, 1m.
        #[arg(long = "for", value_name = "DURATION", value_parser = duration, default_value = "5s")]
        duration: Duration,
    },
    /// Record a running pipeline's messages to an MCAP file (by flockeye-recorder).
    Record,
    #[command(about = replay::REPLAY.about)]
    Replay,
    #[command(about = replay::EXPLAIN.about)]
    Explain,
    /// Show what the swarm's drones report of each other over Zenoh.
    Peers(PeersArguments),
    #[command(about = workshop::SWARM.about)]
    Swarm,
    /// Make keys and certificates, by which the members of a swarm know each other.
    #[command(subcommand)]
    Keys(KeysCommand),
    /// Remove what dead runs left in shared memory.
    Clean {
        /// Only this instance.
        #[arg(long, value_name = "NAME")]
        instance: Option<String>,
    },
    /// Print the JSON Schema of pipeline.yaml.
    Schema,
    /// Show the configured marker bodies.
    Bodies {
        #[command(flatten)]
        configuration: Configuration,
        /// Print every marker's corners and every facet, as a bodies file has them.
        #[arg(long)]
        json: bool,
    },
    #[command(about = workshop::CONTRACT.about)]
    Contract,
    #[command(about = workshop::STAGE.about)]
    Stage,
    /// Become a stage's process (used by `up`).
    #[command(hide = true)]
    ExecStage(ExecArguments),
}

/// Reads the command line and runs the command, or becomes the program that does.
///
/// # Errors
/// The errors of the command.
pub fn run() -> anyhow::Result<()> {
    let arguments: Vec<_> = std::env::args_os().skip(1).collect();
    if let Some(program) = other_programs::program_for(&arguments) {
        return other_programs::become_program(program, &arguments);
    }
    let matches = command().get_matches();
    let command = Flockeye::from_arg_matches(&matches).unwrap_or_else(|error| error.exit()).command;
    match command {
        FlockeyeCommand::Up { configuration, options } => up::run(&configuration, &options),
        FlockeyeCommand::Check { configuration, measure } => check::run(&configuration, measure),
        FlockeyeCommand::Doctor { configuration, json } => doctor::run(&configuration, json),
        FlockeyeCommand::Status { running, json } => {
            manage::ask_and_show(&running, &ControlRequest::Status, json)
        }
        FlockeyeCommand::Swap(arguments) => manage::swap(&arguments),
        FlockeyeCommand::Stop { worker, running } => manage::stop(worker, &running),
        FlockeyeCommand::Start { worker, running } => {
            manage::ask_and_show(&running, &ControlRequest::Start { worker }, false)
        }
        FlockeyeCommand::Restart { worker, running } => {
            manage::ask_and_show(&running, &ControlRequest::Restart { worker }, false)
        }
        FlockeyeCommand::Top(arguments) => top::run(&arguments),
        FlockeyeCommand::Trace { running, out, duration } => trace::run(&running, &out, duration),
        // Other programs run these commands, unless something else comes first.
        FlockeyeCommand::Record
        | FlockeyeCommand::View
        | FlockeyeCommand::Replay
        | FlockeyeCommand::Explain
        | FlockeyeCommand::Chaos
        | FlockeyeCommand::Swarm
        | FlockeyeCommand::Contract
        | FlockeyeCommand::Stage => {
            anyhow::bail!(
                "`flockeye record`, `view`, `replay`, `explain`, `chaos`, `swarm`, `contract` and `stage` are written \
                 without anything before them"
            )
        }
        FlockeyeCommand::Peers(arguments) => peers::run(&arguments),
        FlockeyeCommand::Keys(command) => keys::run(&command),
        FlockeyeCommand::Clean { instance } => clean::run(instance.as_deref()),
        FlockeyeCommand::Schema => {
            let schema = serde_json::to_string_pretty(&flockeye_config::json_schema())?;
            Screen::new().line(&schema);
            Ok(())
        }
        FlockeyeCommand::Bodies { configuration, json } => bodies::run(&configuration, json),
        FlockeyeCommand::ExecStage(arguments) => exec::run(&arguments),
    }
}

/// The whole command line. The lab's commands are in it for the help, and so that a misspelled one
/// gets a suggestion; they never arrive here ([`other_programs`]).
fn command() -> clap::Command {
    let hidden = lab::COMMANDS.map(|command| clap::Command::new(command.name).hide(true));
    let template = format!(
        "{{about-with-newline}}\n{{usage-heading}} {{usage}}\n\nCommands:\n{{subcommands}}\n\n\
         Evaluation and preparation (by flockeye-lab):\n{}\n\nOptions:\n{{options}}{{after-help}}",
        other_programs::listing()
    );
    own_command().help_template(template).subcommands(hidden)
}

/// The command line without the lab's commands.
pub fn own_command() -> clap::Command {
    Flockeye::command()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_is_well_formed() {
        command().debug_assert();
    }

    #[test]
    fn the_help_lists_the_commands_of_all_programs() {
        let help = command().render_help().to_string();
        for wanted in [
            "  up ",
            "  record ",
            "  replay ",
            "  chaos ",
            "  stage ",
            "  schema ",
            "  eval ",
            "  calibrate ",
            "(by flockeye-lab):",
        ] {
            assert!(help.contains(wanted), "{wanted:?} is missing in:\n{help}");
        }
        assert!(!help.contains("exec-stage"), "{help}");
    }

    #[test]
    fn misspelled_commands_of_the_lab_get_a_suggestion() {
        let error = command().try_get_matches_from(["flockeye", "evl"]).map(drop);
        let text = error.expect_err("there is no such command").to_string();
        assert!(text.contains("'eval'"), "{text}");
    }
}
