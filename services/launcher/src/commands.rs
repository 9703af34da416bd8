//! The command line.

use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
use flockeye_cli::{lab, replay, workshop};

use crate::bodies::{self, BodiesArguments};
use crate::check::{self, CheckArguments};
use crate::clean::{self, CleanArguments};
use crate::doctor::{self, DoctorArguments};
use crate::exec::{self, ExecArguments};
use crate::keys::{self, KeysCommand};
use crate::manage::{self, StatusArguments, StopArguments, SwapArguments, WorkerArguments};
use crate::other_programs::{self, PassedOn};
use crate::peers::{self, PeersArguments};
use crate::schema;
use crate::top::{self, TopArguments};
use crate::trace::{self, TraceArguments};
use crate::up::{self, UpArguments};

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
    Up(UpArguments),
    /// Check a configuration, and say what it means on this machine.
    Check(CheckArguments),
    /// Look for everything on this machine that could keep it from flying, and say what to do about
    /// it.
    Doctor(DoctorArguments),
    /// Show a running pipeline's processes.
    Status(StatusArguments),
    /// Replace a stage's process in flight by another one, so that no frame is lost.
    Swap(SwapArguments),
    /// End a stage of a running pipeline, or the whole pipeline.
    Stop(StopArguments),
    /// Start a stage of a running pipeline that was ended.
    Start(WorkerArguments),
    /// End a stage of a running pipeline, and start it again.
    Restart(WorkerArguments),
    #[command(about = workshop::CHAOS.about)]
    Chaos,
    /// Show what a running pipeline's stages do, and how old its poses are.
    Top(TopArguments),
    /// Show what a running pipeline sees, on a page in the browser.
    View,
    /// Record the path of frames through a running pipeline, for Perfetto (ui.perfetto.dev).
    Trace(TraceArguments),
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
    Clean(CleanArguments),
    /// Print the JSON Schema of pipeline.yaml.
    Schema,
    /// Show the configured marker bodies.
    Bodies(BodiesArguments),
    #[command(about = workshop::CONTRACT.about)]
    Contract,
    #[command(about = workshop::STAGE.about)]
    Stage,
    /// Become a stage's process (used by `up`).
    #[command(hide = true)]
    ExecStage(ExecArguments),
}

/// Reads the command line and does what it asks for, or becomes the program that does.
///
/// # Errors
/// As the command.
pub fn run() -> anyhow::Result<()> {
    let arguments: Vec<_> = std::env::args_os().skip(1).collect();
    if let Some(command) = PassedOn::of(&arguments) {
        return command.become_program();
    }
    let matches = command().get_matches();
    let command = Flockeye::from_arg_matches(&matches).unwrap_or_else(|error| error.exit()).command;
    match command {
        FlockeyeCommand::Up(arguments) => up::run(&arguments),
        FlockeyeCommand::Check(arguments) => check::run(&arguments),
        FlockeyeCommand::Doctor(arguments) => doctor::run(&arguments),
        FlockeyeCommand::Status(arguments) => manage::status(&arguments),
        FlockeyeCommand::Swap(arguments) => manage::swap(&arguments),
        FlockeyeCommand::Stop(arguments) => manage::stop(&arguments),
        FlockeyeCommand::Start(arguments) => manage::start(&arguments),
        FlockeyeCommand::Restart(arguments) => manage::restart(&arguments),
        FlockeyeCommand::Top(arguments) => top::run(&arguments),
        FlockeyeCommand::Trace(arguments) => trace::run(&arguments),
        // They were passed on, unless something else comes first.
        FlockeyeCommand::Record
        | FlockeyeCommand::View
        | FlockeyeCommand::Replay
        | FlockeyeCommand::Explain
        | FlockeyeCommand::Chaos
        | FlockeyeCommand::Swarm
        | FlockeyeCommand::Contract
        | FlockeyeCommand::Stage => {
            anyhow::bail!("a command of another program is written without anything before it")
        }
        FlockeyeCommand::Peers(arguments) => peers::run(&arguments),
        FlockeyeCommand::Keys(command) => keys::run(&command),
        FlockeyeCommand::Clean(arguments) => clean::run(&arguments),
        FlockeyeCommand::Schema => schema::run(),
        FlockeyeCommand::Bodies(arguments) => bodies::run(&arguments),
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
