//! The command line.

use clap::{CommandFactory, Parser, Subcommand};
use flockeye_cli::lab;

use crate::calibrate::{
    self, CalibrateBodyArguments, CalibrateImuArguments, CalibrateLensesArguments,
    CalibrateMountArguments, CalibrateResponseArguments,
};
use crate::eval::{self, EvalArguments};
use crate::experiment::{self, ExperimentArguments};
use crate::markers::{self, MarkersArguments};
use crate::partition::{self, PartitionArguments};

/// Flockeye's lab: it prepares runs and evaluates them.
#[derive(Debug, Parser)]
#[command(name = lab::PROGRAM, version)]
struct Lab {
    /// What to do.
    #[command(subcommand)]
    command: LabSubcommand,
}

// The descriptions are in `flockeye_cli::lab`, because the help of `flockeye` shows them too.
#[derive(Debug, Subcommand)]
enum LabSubcommand {
    #[command(about = lab::EVAL.about)]
    Eval(EvalArguments),
    #[command(about = lab::EXPERIMENT.about)]
    Experiment(ExperimentArguments),
    #[command(about = lab::PARTITION.about)]
    Partition(PartitionArguments),
    #[command(about = lab::MARKERS.about)]
    Markers(MarkersArguments),
    #[command(subcommand, about = lab::CALIBRATE.about)]
    Calibrate(CalibrateSubcommand),
}

#[derive(Debug, Subcommand)]
enum CalibrateSubcommand {
    /// Measure where a body's hand-glued markers really are.
    Body(CalibrateBodyArguments),
    /// Measure where the camera sits on the drone, by a body at measured places.
    Mount(CalibrateMountArguments),
    /// Measure how the camera's two lenses lie to each other, by a body that is carried across their seam.
    Lenses(CalibrateLensesArguments),
    /// Measure how the inertial sensor lies to the camera, and its time offset.
    Imu(CalibrateImuArguments),
    /// Measure how late the camera's frames arrive, by the inertial sensor.
    Latency(CalibrateImuArguments),
    /// Measure the curve between light and code values, from pictures at several exposures.
    Response(CalibrateResponseArguments),
}

/// Reads the command line and does what it asks for.
///
/// # Errors
/// As the command.
pub fn run() -> anyhow::Result<()> {
    match Lab::parse().command {
        LabSubcommand::Eval(arguments) => eval::run(&arguments),
        LabSubcommand::Experiment(arguments) => experiment::run(&arguments),
        LabSubcommand::Partition(arguments) => partition::run(&arguments),
        LabSubcommand::Markers(arguments) => markers::run(&arguments),
        LabSubcommand::Calibrate(CalibrateSubcommand::Body(arguments)) => {
            calibrate::body::run(&arguments)
        }
        LabSubcommand::Calibrate(CalibrateSubcommand::Mount(arguments)) => {
            calibrate::mount::run(&arguments)
        }
        LabSubcommand::Calibrate(CalibrateSubcommand::Lenses(arguments)) => {
            calibrate::lenses::run(&arguments)
        }
        LabSubcommand::Calibrate(CalibrateSubcommand::Imu(arguments)) => {
            calibrate::imu::run(&arguments)
        }
        LabSubcommand::Calibrate(CalibrateSubcommand::Latency(arguments)) => {
            calibrate::latency::run(&arguments)
        }
        LabSubcommand::Calibrate(CalibrateSubcommand::Response(arguments)) => {
            calibrate::response::run(&arguments)
        }
    }
}

/// The command line.
pub fn command() -> clap::Command {
    Lab::command()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_is_well_formed() {
        Lab::command().debug_assert();
    }

    #[test]
    fn flockeye_knows_every_command() {
        let command = Lab::command();
        let own: Vec<_> = command.get_subcommands().map(|command| command.get_name()).collect();
        assert_eq!(own, lab::COMMANDS.map(|command| command.name));
    }
}
