//! The paper's Table I, "Sphere partition comparison".

use std::fmt;

use flockeye_cli::text_table::TextTable;
use flockeye_config::{Profile, Resolved};
use serde::Serialize;

use super::comparison::{
    BesidePaper, ComparisonArguments, FlightOutcome, LEGEND, TITLES, given_truth,
};
use super::laboratory::Laboratory;

/// A column of the paper's table.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub(super) struct PaperPartition {
    /// N.
    count: usize,
    /// The circles' diameter, degrees.
    theta_deg: f64,
    /// Frames per second.
    frames_per_s: f64,
    /// Mean error, centimetres.
    error_cm: f64,
    /// Frames in which the drone was localised.
    captured: usize,
}

/// The paper's Table I, of its experiment 1.
static TABLE_1: [PaperPartition; 3] = [
    PaperPartition { count: 6, theta_deg: 110.0, frames_per_s: 6.0, error_cm: 9.9, captured: 281 },
    PaperPartition { count: 12, theta_deg: 74.0, frames_per_s: 4.5, error_cm: 3.8, captured: 395 },
    PaperPartition { count: 24, theta_deg: 62.0, frames_per_s: 2.8, error_cm: 6.6, captured: 299 },
];

/// The result of one partition.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct PartitionOutcome {
    /// N.
    count: usize,
    /// paper or covering.
    method: &'static str,
    /// The circles' diameter, degrees.
    theta_deg: f64,
    /// The flight.
    #[serde(flatten)]
    outcome: FlightOutcome,
}

/// Runs a flight for each number of views and each method. As in the paper, frames are searched by
/// its optimized search (Algorithm 1), without a filter.
pub(super) fn run(
    arguments: &ComparisonArguments,
) -> anyhow::Result<BesidePaper<PartitionOutcome, PaperPartition>> {
    let given = given_truth(arguments)?;
    let configuration = match arguments.configuration.says_profile() {
        true => arguments.configuration.clone(),
        false => arguments.configuration.clone().in_profile(Profile::Stills),
    };
    let defaults = ["search.mode=optimized"];
    let mut laboratory =
        Laboratory::new(&configuration, &defaults, arguments.frames, arguments.json)?;
    let mut rows = Vec::new();
    for paper in &TABLE_1 {
        for method in ["paper", "covering"] {
            let count = paper.count;
            let fixed = [format!("partition.count={count}"), format!("partition.method={method}")];
            let (pipeline, plan) = laboratory.plan(&fixed)?;
            let division = Resolved::of(pipeline)?.division;
            let theta_deg = division.partition.covering_diameter_rad().to_degrees();
            let flight = laboratory.fly(&format!("N = {count}, {method}"), &plan)?;
            let outcome = FlightOutcome::of(&flight, given.as_ref().unwrap_or(&flight.truth))?;
            rows.push(PartitionOutcome { count, method, theta_deg, outcome });
        }
    }
    Ok(BesidePaper { rows, paper: &TABLE_1 })
}

impl fmt::Display for BesidePaper<PartitionOutcome, PaperPartition> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let titles = [&["N", "partition", "θ °"], &TITLES[..]].concat();
        let mut table = TextTable::new(2, &titles);
        for paper in self.paper {
            for row in self.rows.iter().filter(|row| row.count == paper.count) {
                let cells =
                    [row.count.to_string(), row.method.to_owned(), format!("{:.2}", row.theta_deg)];
                table.row(cells.into_iter().chain(row.outcome.cells()));
            }
            table.row([
                paper.count.to_string(),
                "(Table I)".to_owned(),
                format!("{:.0}", paper.theta_deg),
                format!("{:.1}", paper.frames_per_s),
                String::new(),
                format!("{:.1}", paper.error_cm),
                String::new(),
                paper.captured.to_string(),
            ]);
        }
        writeln!(f, "{}", table.text())?;
        write!(f, "{LEGEND}\nTable I is the paper's: another flight and computer, in real time")
    }
}
