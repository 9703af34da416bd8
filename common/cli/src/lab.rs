//! The commands of `flockeye-lab`, which `flockeye` has too: it passes them on.

/// The program that has them.
pub const PROGRAM: &str = "flockeye-lab";

/// A command and what it does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LabCommand {
    /// Its name on the command line.
    pub name: &'static str,
    /// What it does, in one line.
    pub about: &'static str,
}

/// Compares poses with the truth.
pub const EVAL: LabCommand =
    LabCommand { name: "eval", about: "Compare recorded poses with the truth" };
/// Runs experiments.
pub const EXPERIMENT: LabCommand = LabCommand {
    name: "experiment",
    about: "Compute the paper's tables again, compare detectors, and check whether covariances are consistent",
};
/// Shows partitions.
pub const PARTITION: LabCommand =
    LabCommand { name: "partition", about: "Tabulate and draw partitions of the sphere" };
/// Draws marker sheets.
pub const MARKERS: LabCommand = LabCommand {
    name: "markers",
    about: "Draw a body's marker sheets at true scale, to print, cut out and glue",
};
/// Calibrates bodies, sensors and cameras.
pub const CALIBRATE: LabCommand = LabCommand {
    name: "calibrate",
    about: "Measure how a body was really built, where the camera sits, how its lenses and the inertial sensor lie, \
            how late frames arrive, or what code values stand for",
};

/// All of them, in the order of the help.
pub const COMMANDS: [LabCommand; 5] = [EVAL, EXPERIMENT, PARTITION, MARKERS, CALIBRATE];
