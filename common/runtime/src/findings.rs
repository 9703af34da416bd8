//! Findings of the examination of a machine before a flight (`flockeye doctor`).
//!
//! Each stage's program examines the machine for its own requirements. It is started with the one
//! argument [`EXAMINE`], and the configuration as JSON on standard input. It prints a [`Report`] as
//! JSON.

use std::io::{Read, Write};

use flockeye_config::Pipeline;
use flockeye_contract::CONTRACT_VERSION;
use serde::{Deserialize, Serialize};

/// The argument with which a stage's program examines the machine instead of joining a pipeline.
pub const EXAMINE: &str = "examine";

/// Severity of a finding.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Gravity {
    /// No problem.
    Fine,
    /// Information.
    Note,
    /// The drone can fly, with less performance than possible.
    Warning,
    /// The drone cannot fly.
    Problem,
}

/// Finding about one subject.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Finding {
    /// Subject in a word or two: `camera`, `clock`.
    pub topic: String,
    /// Severity.
    pub gravity: Gravity,
    /// The finding in words.
    pub what: String,
    /// Cure, if there is something to do.
    pub cure: Option<String>,
}

impl Finding {
    /// A finding without a problem.
    pub fn fine(topic: &str, what: impl Into<String>) -> Self {
        Self { topic: topic.to_owned(), gravity: Gravity::Fine, what: what.into(), cure: None }
    }

    /// A finding for information.
    pub fn note(topic: &str, what: impl Into<String>) -> Self {
        Self { gravity: Gravity::Note, ..Self::fine(topic, what) }
    }

    /// A finding that makes flights worse.
    pub fn warning(topic: &str, what: impl Into<String>, cure: impl Into<String>) -> Self {
        let cure = Some(cure.into());
        Self { gravity: Gravity::Warning, cure, ..Self::fine(topic, what) }
    }

    /// A finding that makes flights impossible.
    pub fn problem(topic: &str, what: impl Into<String>, cure: impl Into<String>) -> Self {
        let cure = Some(cure.into());
        Self { gravity: Gravity::Problem, cure, ..Self::fine(topic, what) }
    }

    /// The finding with its cure.
    pub fn with_cure(self, cure: impl Into<String>) -> Self {
        Self { cure: Some(cure.into()), ..self }
    }
}

/// Output of a stage's program.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Report {
    /// Version of the contract that it was built with.
    pub contract: String,
    /// Version of the program.
    pub version: String,
    /// Its findings.
    pub findings: Vec<Finding>,
}

impl Report {
    /// The findings of a program of this build.
    pub fn of(findings: Vec<Finding>) -> Self {
        Self {
            contract: CONTRACT_VERSION.to_owned(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            findings,
        }
    }
}

/// Reads the configuration from `input`, and writes the findings of `examine` to `output`.
///
/// # Errors
/// The configuration cannot be read, or the report cannot be written.
pub fn answer(
    mut input: impl Read,
    mut output: impl Write,
    examine: impl FnOnce(&Pipeline) -> Vec<Finding>,
) -> anyhow::Result<()> {
    let mut json = String::new();
    input.read_to_string(&mut json)?;
    let pipeline: Pipeline = serde_json::from_str(&json)?;
    serde_json::to_writer(&mut output, &Report::of(examine(&pipeline)))?;
    Ok(output.flush()?)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    #[test]
    fn a_program_answers_with_what_it_found() {
        let json = serde_json::to_vec(&Pipeline::default()).unwrap();
        let mut said = Vec::new();
        let found = |pipeline: &Pipeline| {
            vec![Finding::problem("camera", &pipeline.source.input, "plug one in")]
        };
        answer(&json[..], &mut said, found).unwrap();
        let report: Report = serde_json::from_slice(&said).unwrap();
        assert_eq!(report.contract, CONTRACT_VERSION);
        assert_eq!(report.findings, [Finding::problem("camera", "sim", "plug one in")]);
        assert!(answer(&b"{"[..], &mut said, |_| Vec::new()).is_err());
    }
}
