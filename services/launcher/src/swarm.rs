//! `flockeye swarm`: a whole swarm on one machine.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`sim`] | flies one in a simulated world, and says how good its poses are |
//! | [`fleet`] | its pipelines' processes |
//! | [`watch`] | what each pipeline says, and what is true |
//! | [`score`] | the one beside the other |
//! | `map` | a swarm as a map of characters |

pub mod fleet;
pub(crate) mod map;
pub mod score;
pub mod sim;
pub mod watch;

use clap::Subcommand;

use self::sim::SimArguments;

/// Commands of `flockeye swarm`.
#[derive(Debug, Subcommand)]
pub enum SwarmCommand {
    /// Fly several drones in one simulated world: a pipeline for each, on this machine. Then compare where each
    /// has the others with the truth.
    Sim(SimArguments),
}

/// Runs one.
///
/// # Errors
/// As the command.
pub fn run(command: &SwarmCommand) -> anyhow::Result<()> {
    match command {
        SwarmCommand::Sim(arguments) => sim::run(arguments),
    }
}
