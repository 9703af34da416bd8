//! The paper's Table I, "Sphere partition comparison".

use std::fmt;

use serde::Serialize;

use super::{LEGEND, Laboratory, Outcome, given_truth, titles};
use crate::cli::Comparison;

/// A column of the paper's table.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
struct Papers {
    /// N.
    count: usize,
    /// The circles' diameter, degrees.
    theta_deg: f64,
    /// Frames a second.
    frames_per_s: f64,
    /// Mean error, centimetres.
    error_cm: f64,
    /// Frames in which the drone was localised.
    captured: usize,
}

/// The paper's Table I, of its experiment 1.
const TABLE_1: [Papers; 3] = [
    Papers { count: 6, theta_deg: 110.0, frames_per_s: 6.0, error_cm: 9.9, captured: 281 },
    Papers { count: 12, theta_deg: 74.0, frames_per_s: 4.5, error_cm: 3.8, captured: 395 },
    Papers { count: 24, theta_deg: 62.0, frames_per_s: 2.8, error_cm: 6.6, captured: 299 },
];

/// One way to cut the sphere.
#[derive(Debug, Clone, PartialEq, Serialize)]
struct Row {
    /// N.
    count: usize,
    /// paper or covering.
    method: &'static str,
    /// The circles' diameter, degrees.
    theta_deg: f64,
    /// What it came to.
    #[serde(flatten)]
    outcome: Outcome,
}

/// What was found, and what the paper says.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct Partitions {
    rows: Vec<Row>,
    paper: [Papers; 3],
}

/// Flies once for each number of views and method. As in the paper, where its optimized search was
/// used throughout, frames are searched by Algorithm 1 and each stands for itself.
pub(super) fn work_out(arguments: &Comparison) -> anyhow::Result<Partitions> {
    let given = given_truth(arguments)?;
    let usual = ["search.mode=optimized", "fusion.filter=none"];
    let mut laboratory =
        Laboratory::new(&arguments.configuration, &usual, arguments.frames, arguments.json)?;
    let mut rows = Vec::new();
    for papers in &TABLE_1 {
        for method in ["paper", "covering"] {
            let count = papers.count;
            let fixed = [format!("partition.count={count}"), format!("partition.method={method}")];
            let pipeline = laboratory.pipeline(&fixed)?;
            let theta_deg = pipeline.sphere_partition()?.covering_diameter_rad().to_degrees();
            let flown = laboratory.fly(&format!("N = {count}, {method}"), &pipeline)?;
            let outcome = Outcome::of(&flown, given.as_ref().unwrap_or(&flown.truth))?;
            rows.push(Row { count, method, theta_deg, outcome });
        }
    }
    Ok(Partitions { rows, paper: TABLE_1 })
}

impl fmt::Display for Partitions {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{:>3} {:<13} {:>7}{}", "N", "cut by", "θ °", titles())?;
        for papers in &self.paper {
            for row in self.rows.iter().filter(|row| row.count == papers.count) {
                writeln!(
                    f,
                    "{:>3} {:<13} {:>7.2}{}",
                    row.count,
                    row.method,
                    row.theta_deg,
                    row.outcome.columns()
                )?;
            }
            writeln!(
                f,
                "{:>3} {:<13} {:>7.0}{:>8.1} {:>8} {:>9.1} {:>9} {:>8}",
                papers.count,
                "(Table I)",
                papers.theta_deg,
                papers.frames_per_s,
                "",
                papers.error_cm,
                "",
                papers.captured
            )?;
        }
        write!(f, "{LEGEND}\nTable I is the paper's, of its own flight and computer, in real time")
    }
}
