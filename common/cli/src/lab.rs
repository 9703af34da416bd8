//! The commands of `flockeye-lab`, which `flockeye` has too: it passes them on.

use crate::program::CommandInfo;

/// The program that does them.
pub const PROGRAM: &str = "flockeye-lab";

/// Compares poses with the truth.
pub const EVAL: CommandInfo =
    CommandInfo { name: "eval", about: "Compare recorded poses with the truth" };
/// Runs experiments.
pub const EXPERIMENT: CommandInfo = CommandInfo {
    name: "experiment",
    about: "Compute the paper's tables again, compare detectors, and check whether covariances are consistent",
};
/// Shows partitions.
pub const PARTITION: CommandInfo =
    CommandInfo { name: "partition", about: "Tabulate and draw partitions of the sphere" };
/// Draws marker sheets.
pub const MARKERS: CommandInfo = CommandInfo {
    name: "markers",
    about: "Draw a body's marker sheets at true scale, to print, cut out and glue",
};
/// Calibrates bodies, sensors and cameras.
pub const CALIBRATE: CommandInfo = CommandInfo {
    name: "calibrate",
    about: "Measure how a body was really built, where the camera sits, how its lenses and the inertial sensor lie, \
            how late frames arrive, or what code values stand for",
};

/// Draws simulated flights as videos.
pub const FILM: CommandInfo =
    CommandInfo { name: "film", about: "Draw a simulated flight as a video, with its truth" };

/// All of them, in the order of the help.
pub const COMMANDS: [CommandInfo; 6] = [EVAL, EXPERIMENT, FILM, PARTITION, MARKERS, CALIBRATE];
