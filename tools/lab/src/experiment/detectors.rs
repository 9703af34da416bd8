//! Comparison of our detector with OpenCV's, on photographs or on flights.

use std::fmt;
use std::path::PathBuf;

use clap::Args;
use flockeye_cli::text_table::TextTable;
use serde::Serialize;

use super::comparison::{ComparisonArguments, FlightOutcome, LEGEND, TITLES, given_truth};
use super::laboratory::Laboratory;
use super::photographs::{self, PhotographComparison};

/// Arguments of `experiment detectors`.
#[derive(Debug, Args)]
pub(crate) struct DetectorsArguments {
    /// Search the photographs in this folder, each as one view, in place of a flight.
    #[arg(long, value_name = "FOLDER")]
    pub photographs: Option<PathBuf>,
    /// The markers in the photographs: a name as OpenCV has it, or a dictionary file; left out:
    /// `bodies.dictionary`.
    #[arg(long, value_name = "NAME", requires = "photographs")]
    pub dictionary: Option<String>,
    /// Write the corners that both find in the photographs, with their stated standard deviations,
    /// as CSV.
    #[arg(long, value_name = "FILE.csv", requires = "photographs")]
    pub corners: Option<PathBuf>,
    /// The flights.
    #[command(flatten)]
    pub comparison: ComparisonArguments,
}

/// The result of one detector's flight.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct DetectorOutcome {
    /// own or opencv.
    engine: &'static str,
    /// The flight.
    #[serde(flatten)]
    outcome: FlightOutcome,
}

/// The comparison of both detectors.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum DetectorComparison {
    /// On flights.
    Flights(Vec<DetectorOutcome>),
    /// On photographs.
    Photographs(PhotographComparison),
}

/// Compares both detectors. All other settings are as configured.
pub(super) fn run(arguments: &DetectorsArguments) -> anyhow::Result<DetectorComparison> {
    let DetectorsArguments { photographs, dictionary, corners, comparison } = arguments;
    if let Some(folder) = photographs {
        let configured = comparison.configuration.load()?.bodies.dictionary;
        let dictionary = dictionary.as_deref().unwrap_or(&configured);
        let compared = photographs::compare(folder, dictionary, corners.as_deref())?;
        return Ok(DetectorComparison::Photographs(compared));
    }
    let given = given_truth(comparison)?;
    let mut laboratory =
        Laboratory::new(&comparison.configuration, &[], comparison.frames, comparison.json)?;
    let mut rows = Vec::new();
    for engine in ["own", "opencv"] {
        let (_, plan) = laboratory.plan(&[format!("detection.engine={engine}")])?;
        let flight = laboratory.fly(&format!("detector {engine}"), &plan)?;
        let outcome = FlightOutcome::of(&flight, given.as_ref().unwrap_or(&flight.truth))?;
        rows.push(DetectorOutcome { engine, outcome });
    }
    Ok(DetectorComparison::Flights(rows))
}

impl fmt::Display for DetectorComparison {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Photographs(comparison) => comparison.fmt(f),
            Self::Flights(rows) => {
                let mut table = TextTable::new(1, &[&["detector"], &TITLES[..]].concat());
                for DetectorOutcome { engine, outcome } in rows {
                    table.row([(*engine).to_owned()].into_iter().chain(outcome.cells()));
                }
                write!(f, "{}\n{LEGEND}", table.text())
            }
        }
    }
}
