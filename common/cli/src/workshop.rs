//! The commands of `flockeye-workshop`, which `flockeye` has too: it passes them on.

use crate::program::CommandInfo;

/// The program that does them.
pub const PROGRAM: &str = "flockeye-workshop";

/// Disturbs a pipeline.
pub const CHAOS: CommandInfo = CommandInfo {
    name: "chaos",
    about: "Disturb a running pipeline at random, and report how it recovers",
};
/// Simulates a swarm.
pub const SWARM: CommandInfo = CommandInfo { name: "swarm", about: "Fly a swarm on this machine" };
/// Prints the contract.
pub const CONTRACT: CommandInfo = CommandInfo {
    name: "contract",
    about: "Print the contract's types, codes and topics for another language",
};
/// Writes and tests stages.
pub const STAGE: CommandInfo =
    CommandInfo { name: "stage", about: "Write and test stages of your own" };

/// All of them, in the order of the help.
pub const COMMANDS: [CommandInfo; 4] = [CHAOS, SWARM, CONTRACT, STAGE];
