//! `flockeye experiment`: repeats the paper's tables, compares detectors, and tests the consistency
//! of covariances. Each flight is a lossless run of the whole pipeline in its own instance.

mod comparison;
mod consistency;
mod detectors;
mod laboratory;
mod partitions;
mod photographs;
mod search;

use clap::Subcommand;
use flockeye_cli::Screen;
use serde::Serialize;

use comparison::ComparisonArguments;
use consistency::ConsistencyArguments;
use detectors::DetectorsArguments;

/// The experiments.
#[derive(Debug, Subcommand)]
pub(crate) enum ExperimentKind {
    /// The paper's Table I: 6, 12 and 24 views, with its partitions and ours.
    Partitions(ComparisonArguments),
    /// The paper's Table II: how a frame is searched, its two ways and ours.
    Search(ComparisonArguments),
    /// Our detector beside OpenCV's, on flights or on a folder of photographs.
    Detectors(DetectorsArguments),
    /// Whether errors are as large as their covariances say, over many simulated flights.
    Consistency(ConsistencyArguments),
}

/// Runs an experiment.
///
/// # Errors
/// The configuration is wrong, there is no truth, or a flight fails.
pub(crate) fn run(kind: &ExperimentKind) -> anyhow::Result<()> {
    match kind {
        ExperimentKind::Partitions(arguments) => show(&partitions::run(arguments)?, arguments.json),
        ExperimentKind::Search(arguments) => show(&search::run(arguments)?, arguments.json),
        ExperimentKind::Detectors(arguments) => {
            show(&detectors::run(arguments)?, arguments.comparison.json)
        }
        ExperimentKind::Consistency(arguments) => {
            show(&consistency::run(arguments)?, arguments.json)
        }
    }
}

fn show<T: Serialize + ToString>(found: &T, json: bool) -> anyhow::Result<()> {
    let text = if json { serde_json::to_string(found)? } else { found.to_string() };
    Screen::new().line(&text);
    Ok(())
}
