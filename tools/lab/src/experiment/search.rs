//! The paper's Table II, "Search Algorithm Comparison".

use std::fmt;

use flockeye_cli::text_table::TextTable;
use serde::Serialize;

use super::comparison::{
    BesidePaper, ComparisonArguments, FlightOutcome, LEGEND, TITLES, given_truth,
};
use super::laboratory::Laboratory;

/// A column of the paper's table.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub(super) struct PaperSearch {
    /// Search mode.
    mode: &'static str,
    /// Frames in which the drone was localised.
    captured: usize,
    /// Frames in which the drone was in view.
    available: usize,
}

/// The paper's Table II, of its experiment 1.
static TABLE_2: [PaperSearch; 2] = [
    PaperSearch { mode: "greedy", captured: 147, available: 986 },
    PaperSearch { mode: "optimized", captured: 395, available: 986 },
];

/// The result of one search mode.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct SearchOutcome {
    /// greedy, optimized or roi.
    mode: &'static str,
    /// The flight.
    #[serde(flatten)]
    outcome: FlightOutcome,
}

/// Runs a flight for each mode. All other settings are as configured.
pub(super) fn run(
    arguments: &ComparisonArguments,
) -> anyhow::Result<BesidePaper<SearchOutcome, PaperSearch>> {
    let given = given_truth(arguments)?;
    let mut laboratory =
        Laboratory::new(&arguments.configuration, &[], arguments.frames, arguments.json)?;
    let mut rows = Vec::new();
    for mode in ["greedy", "optimized", "roi"] {
        let (_, plan) = laboratory.plan(&[format!("search.mode={mode}")])?;
        let flight = laboratory.fly(&format!("search {mode}"), &plan)?;
        let outcome = FlightOutcome::of(&flight, given.as_ref().unwrap_or(&flight.truth))?;
        rows.push(SearchOutcome { mode, outcome });
    }
    Ok(BesidePaper { rows, paper: &TABLE_2 })
}

impl fmt::Display for BesidePaper<SearchOutcome, PaperSearch> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut table = TextTable::new(1, &[&["search"], &TITLES[..]].concat());
        for row in &self.rows {
            table.row([row.mode.to_owned()].into_iter().chain(row.outcome.cells()));
            for paper in self.paper.iter().filter(|paper| paper.mode == row.mode) {
                let share = 100.0 * paper.captured as f64 / paper.available as f64;
                table.row([
                    format!("{} (Table II)", paper.mode),
                    String::new(),
                    String::new(),
                    String::new(),
                    String::new(),
                    paper.captured.to_string(),
                    paper.available.to_string(),
                    String::new(),
                    format!("{share:.1} %"),
                ]);
            }
        }
        writeln!(f, "{}", table.text())?;
        write!(f, "{LEGEND}\nTable II is the paper's: another flight and computer, in real time")
    }
}
