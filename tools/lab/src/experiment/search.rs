//! The paper's Table II, "Search Algorithm Comparison".

use std::fmt;

use serde::Serialize;

use super::{LEGEND, Laboratory, Outcome, given_truth, titles};
use crate::cli::Comparison;

/// A column of the paper's table.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
struct Papers {
    /// The search.
    mode: &'static str,
    /// Frames in which the drone was localised.
    captured: usize,
    /// Frames in which it could have been.
    available: usize,
}

/// The paper's Table II, of its experiment 1.
const TABLE_2: [Papers; 2] = [
    Papers { mode: "greedy", captured: 147, available: 986 },
    Papers { mode: "optimized", captured: 395, available: 986 },
];

/// One way to search.
#[derive(Debug, Clone, PartialEq, Serialize)]
struct Row {
    /// greedy, optimized or gaze.
    mode: &'static str,
    /// What it came to.
    #[serde(flatten)]
    outcome: Outcome,
}

/// What was found, and what the paper says.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct Searches {
    rows: Vec<Row>,
    paper: [Papers; 2],
}

/// Flies once for each mode; all else is as configured.
pub(super) fn work_out(arguments: &Comparison) -> anyhow::Result<Searches> {
    let given = given_truth(arguments)?;
    let mut laboratory =
        Laboratory::new(&arguments.configuration, &[], arguments.frames, arguments.json)?;
    let mut rows = Vec::new();
    for mode in ["greedy", "optimized", "gaze"] {
        let pipeline = laboratory.pipeline(&[format!("search.mode={mode}")])?;
        let flown = laboratory.fly(&format!("search {mode}"), &pipeline)?;
        let outcome = Outcome::of(&flown, given.as_ref().unwrap_or(&flown.truth))?;
        rows.push(Row { mode, outcome });
    }
    Ok(Searches { rows, paper: TABLE_2 })
}

impl fmt::Display for Searches {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{:<22}{}", "search", titles())?;
        for row in &self.rows {
            writeln!(f, "{:<22}{}", row.mode, row.outcome.columns())?;
            for papers in self.paper.iter().filter(|papers| papers.mode == row.mode) {
                writeln!(
                    f,
                    "{:<22}{:>37} {:>8} {:>8} {:>8} {:>7.1} %",
                    format!("{} (Table II)", papers.mode),
                    "",
                    papers.captured,
                    papers.available,
                    "",
                    100.0 * papers.captured as f64 / papers.available as f64
                )?;
            }
        }
        write!(f, "{LEGEND}\nTable II is the paper's, of its own flight and computer, in real time")
    }
}
