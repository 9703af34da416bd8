//! The command line.

use std::path::PathBuf;

use clap::{CommandFactory, Parser, Subcommand};
use flockeye_cli::{Configuration, lab};

use crate::calibrate::{
    self, CalibrateImuArguments, CalibrateMountArguments, CalibrateResponseArguments,
};
use crate::eval::{self, EvalArguments};
use crate::experiment::{self, ExperimentKind};
use crate::film::{self, FilmArguments};
use crate::markers::{self, MarkersArguments};
use crate::partition::{self, PartitionArguments};

// The descriptions are in `flockeye_cli::lab`, because the help of `flockeye` shows them too.
/// Flockeye's lab: it prepares runs and evaluates them.
#[derive(Debug, Parser)]
#[command(name = lab::PROGRAM, version)]
enum Lab {
    #[command(about = lab::EVAL.about)]
    Eval(EvalArguments),
    #[command(subcommand, about = lab::EXPERIMENT.about)]
    Experiment(ExperimentKind),
    #[command(about = lab::FILM.about)]
    Film(FilmArguments),
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
    Body {
        /// Which configuration: the camera, the bodies as designed, and the recording as its
        /// source.
        #[command(flatten)]
        configuration: Configuration,
        /// Where to write the calibrated bodies: a JSON file for --bodies.
        #[arg(long, value_name = "FILE.json")]
        out: PathBuf,
    },
    /// Measure where the camera sits on the drone, by a body at measured places.
    Mount(CalibrateMountArguments),
    /// Measure how the camera's two lenses lie to each other, by a body that is carried across
    /// their seam.
    Lenses {
        /// Which configuration: the camera as it is believed to be, the bodies, and the recording
        /// as its source.
        #[command(flatten)]
        configuration: Configuration,
        /// For a program.
        #[arg(long)]
        json: bool,
    },
    /// Measure how the inertial sensor lies to the camera, and its time offset.
    Imu(CalibrateImuArguments),
    /// Measure how late the camera's frames arrive, by the inertial sensor.
    Latency(CalibrateImuArguments),
    /// Measure the curve between light and code values, from pictures at several exposures.
    Response(CalibrateResponseArguments),
}

/// Parses the command line and runs the command.
///
/// # Errors
/// The errors of the command.
pub fn run() -> anyhow::Result<()> {
    match Lab::parse() {
        Lab::Eval(arguments) => eval::run(&arguments),
        Lab::Experiment(kind) => experiment::run(&kind),
        Lab::Film(arguments) => film::run(&arguments),
        Lab::Partition(arguments) => partition::run(&arguments),
        Lab::Markers(arguments) => markers::run(&arguments),
        Lab::Calibrate(subcommand) => match subcommand {
            CalibrateSubcommand::Body { configuration, out } => {
                calibrate::body::run(&configuration, &out)
            }
            CalibrateSubcommand::Mount(arguments) => calibrate::mount::run(&arguments),
            CalibrateSubcommand::Lenses { configuration, json } => {
                calibrate::lenses::run(&configuration, json)
            }
            CalibrateSubcommand::Imu(arguments) => calibrate::imu::run(&arguments),
            CalibrateSubcommand::Latency(arguments) => calibrate::latency::run(&arguments),
            CalibrateSubcommand::Response(arguments) => calibrate::response::run(&arguments),
        },
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
