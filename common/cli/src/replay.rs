//! The commands of `flockeye-replay`, which `flockeye` has too: it passes them on.

use crate::program::CommandInfo;

/// The program that does them.
pub const PROGRAM: &str = "flockeye-replay";

/// Replays a stage.
pub const REPLAY: CommandInfo = CommandInfo {
    name: "replay",
    about: "Give a stage alone what it got in a recorded flight, and compare what it gives with what it gave",
};
/// Explains a pose.
pub const EXPLAIN: CommandInfo = CommandInfo {
    name: "explain",
    about: "Say why a frame of a recording gave this pose of a neighbour, or none",
};

/// All of them, in the order of the help.
pub const COMMANDS: [CommandInfo; 2] = [REPLAY, EXPLAIN];
