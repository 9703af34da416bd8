//! The command line.

use clap::{CommandFactory, Parser, Subcommand};
use flockeye_cli::workshop;
use flockeye_launcher::exec::{self, ExecArguments};

use crate::chaos::{self, ChaosArguments};
use crate::conformance::{self, TestArguments};
use crate::contract::{self, ContractForm};
use crate::new_stage::{self, NewArguments};
use crate::swarm_simulation::{self, SimArguments};

// The descriptions are in `flockeye_cli::workshop`, because the help of `flockeye` shows them too.
/// Flockeye's workshop: it helps to write stages, and tries pipelines out.
#[derive(Debug, Parser)]
#[command(name = workshop::PROGRAM, version)]
enum Workshop {
    #[command(about = workshop::CHAOS.about)]
    Chaos(ChaosArguments),
    #[command(subcommand, about = workshop::SWARM.about)]
    Swarm(SwarmCommand),
    #[command(about = workshop::CONTRACT.about)]
    Contract {
        /// In which form.
        #[arg(value_enum)]
        form: ContractForm,
    },
    #[command(subcommand, about = workshop::STAGE.about)]
    Stage(StageCommand),
    /// Become a process that ends with this one (used by the other commands).
    #[command(hide = true)]
    ExecStage(ExecArguments),
}

#[derive(Debug, Subcommand)]
enum SwarmCommand {
    /// Fly several drones in one simulated world: a pipeline for each, on this machine. Then
    /// compare where each has the others with the truth.
    Sim(SimArguments),
}

#[derive(Debug, Subcommand)]
enum StageCommand {
    /// Write a stage that runs as it is.
    New(NewArguments),
    /// Test a stage alone against the contract.
    Test(TestArguments),
}

/// Parses the command line and runs the command.
///
/// # Errors
/// The errors of the command.
pub fn run() -> anyhow::Result<()> {
    match Workshop::parse() {
        Workshop::Chaos(arguments) => chaos::run(&arguments),
        Workshop::Swarm(SwarmCommand::Sim(arguments)) => swarm_simulation::run(&arguments),
        Workshop::Contract { form } => {
            contract::print(form);
            Ok(())
        }
        Workshop::Stage(StageCommand::New(arguments)) => new_stage::run(&arguments),
        Workshop::Stage(StageCommand::Test(arguments)) => conformance::run(&arguments),
        Workshop::ExecStage(arguments) => exec::run(&arguments),
    }
}

/// The command line.
pub fn command() -> clap::Command {
    Workshop::command()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_is_well_formed() {
        command().debug_assert();
    }

    #[test]
    fn flockeye_knows_every_command() {
        let command = command();
        let own = command.get_subcommands().filter(|command| !command.is_hide_set());
        let own: Vec<_> = own.map(|command| (command.get_name(), command.get_about())).collect();
        let wanted = workshop::COMMANDS.map(|command| (command.name, Some(command.about.into())));
        assert_eq!(own.len(), wanted.len());
        for ((name, about), (wanted_name, wanted_about)) in own.into_iter().zip(wanted) {
            assert_eq!((name, about.cloned()), (wanted_name, wanted_about));
        }
    }
}
