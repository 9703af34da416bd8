//! `flockeye eval`: compares recorded poses with the truth.

use std::collections::BTreeSet;
use std::path::PathBuf;

use anyhow::ensure;
use clap::Args;
use flockeye_cli::Screen;
use flockeye_record::{PoseRow, TruthRow, read};

use crate::evaluation::Evaluation;
use crate::report;

/// Arguments of `eval`.
#[derive(Debug, Args)]
pub struct EvalArguments {
    /// The recorded poses.
    #[arg(long, value_name = "FILE.csv")]
    pub poses: PathBuf,
    /// The truth.
    #[arg(long, value_name = "FILE.csv")]
    pub truth: PathBuf,
    /// One JSON object instead of a table.
    #[arg(long)]
    pub json: bool,
    /// Write a page with the paper's figures for this run, index.html, into this folder.
    #[arg(long, value_name = "DIR")]
    pub report: Option<PathBuf>,
}

/// Prints the comparison, and writes the report if one is asked for.
///
/// # Errors
/// A file cannot be read or is invalid, the two share no frame, or the report cannot be written.
pub fn run(arguments: &EvalArguments) -> anyhow::Result<()> {
    let poses: Vec<PoseRow> = read(&arguments.poses)?;
    let truth: Vec<TruthRow> = read(&arguments.truth)?;
    let [poses_file, truth_file] = [&arguments.poses, &arguments.truth].map(|path| path.display());
    ensure!(
        !truth.is_empty(),
        "{truth_file} says nothing of any frame: there is nothing to compare with. Cure: give the \
         truth of the same flight; only a simulated one writes it (flockeye up --truth), a camera \
         or a recording has none of its own"
    );
    let frames = |numbers: Vec<u64>| {
        let (first, last) = (numbers.iter().min(), numbers.iter().max());
        format!("{} to {}", first.unwrap_or(&0), last.unwrap_or(&0))
    };
    let known: BTreeSet<u64> = truth.iter().map(|row| row.frame).collect();
    ensure!(
        poses.is_empty() || poses.iter().any(|pose| known.contains(&pose.frame)),
        "{poses_file} (frames {}) and {truth_file} (frames {}) share no frame. Cure: give poses \
         and truth of the same flight",
        frames(poses.iter().map(|pose| pose.frame).collect()),
        frames(truth.iter().map(|row| row.frame).collect()),
    );
    let evaluation = Evaluation::of(&poses, &truth);
    let mut screen = Screen::new();
    if arguments.json {
        screen.line(&serde_json::to_string(&evaluation)?);
    } else {
        screen.line(&evaluation.to_string());
    }
    if let Some(folder) = &arguments.report {
        let source = format!("{poses_file} against {truth_file}");
        let file = report::write(folder, &source, &evaluation, &poses, &truth)?;
        if !arguments.json {
            screen.line(&format!("the report is {}", file.display()));
        }
    }
    Ok(())
}
