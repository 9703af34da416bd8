//! `flockeye eval`: compares recorded poses and rotations with the truth.

use std::collections::BTreeSet;
use std::path::Path;
use std::path::PathBuf;

use anyhow::{Context, ensure};
use clap::Args;
use flockeye_cli::Screen;
use flockeye_tables::{ImuRow, PoseRow, RotationRow, TruthRow, read};
use serde_json::json;

use crate::evaluation::Evaluation;
use crate::evaluation::rotations::{RotationEvaluation, TrueRotation};
use crate::report;

/// Arguments of `eval`.
#[derive(Debug, Args)]
pub(crate) struct EvalArguments {
    /// The recorded poses.
    #[arg(
        long,
        value_name = "FILE.csv",
        requires = "truth",
        required_unless_present = "rotations"
    )]
    pub poses: Option<PathBuf>,
    /// The truth.
    #[arg(long, value_name = "FILE.csv")]
    pub truth: Option<PathBuf>,
    /// The recorded rotations of the camera, against the attitudes of the truth or a gyroscope.
    #[arg(long, value_name = "FILE.csv")]
    pub rotations: Option<PathBuf>,
    /// A gyroscope's samples, in the camera's axes, to compare rotations with: t_s, gx, gy, gz (s,
    /// rad/s).
    #[arg(long, value_name = "FILE.csv", requires = "rotations")]
    pub gyro: Option<PathBuf>,
    /// One JSON object instead of a table.
    #[arg(long)]
    pub json: bool,
    /// Write a page with the paper's figures for this run, index.html, into this folder.
    #[arg(long, value_name = "DIR", requires = "poses")]
    pub report: Option<PathBuf>,
}

/// Prints the comparison, and writes the report if requested.
///
/// # Errors
/// A file cannot be read or is invalid, the files have no frame in common, or the report cannot be
/// written.
pub(crate) fn run(arguments: &EvalArguments) -> anyhow::Result<()> {
    let truth: Vec<TruthRow> = match &arguments.truth {
        Some(file) => {
            let truth = read(file)?;
            ensure!(
                !truth.is_empty(),
                "{} says nothing of any frame: there is nothing to compare with. Cure: give the \
                 truth of the same flight; only a simulated one writes it (flockeye up --truth), a \
                 camera or a recording has none of its own",
                file.display()
            );
            truth
        }
        None => Vec::new(),
    };
    let poses: Option<Vec<PoseRow>> = arguments.poses.as_deref().map(read).transpose()?;
    if let (Some(poses), Some(poses_file), Some(truth_file)) =
        (&poses, &arguments.poses, &arguments.truth)
    {
        share_a_frame(poses.iter().map(|pose| pose.frame), poses_file, &truth, truth_file)?;
    }
    let rotations = arguments.rotations.as_deref();
    let rotations = rotations.map(|file| compare_rotations(file, arguments, &truth)).transpose()?;
    let evaluation = poses.as_deref().map(|poses| Evaluation::of(poses, &truth));
    let mut screen = Screen::new();
    if arguments.json {
        let mut json = evaluation.as_ref().map_or_else(|| Ok(json!({})), serde_json::to_value)?;
        if let Some(rotations) = &rotations {
            json["rotations"] = serde_json::to_value(rotations)?;
        }
        screen.line(&json.to_string());
    } else {
        let poses = evaluation.as_ref().map(Evaluation::to_string);
        let rotations = rotations.as_ref().map(RotationEvaluation::to_string);
        poses.iter().chain(&rotations).for_each(|text| screen.line(text));
    }
    if let (Some(folder), Some(poses), Some(evaluation)) = (&arguments.report, &poses, &evaluation)
    {
        let shown = |file: &Option<PathBuf>| {
            file.as_ref().map_or(String::new(), |file| file.display().to_string())
        };
        let source = format!("{} against {}", shown(&arguments.poses), shown(&arguments.truth));
        let file = report::write(folder, &source, evaluation, poses, &truth)?;
        if !arguments.json {
            screen.line(&format!("the report is {}", file.display()));
        }
    }
    Ok(())
}

/// Compares rotations with the gyroscope if one is given, else with the attitudes of the truth.
fn compare_rotations(
    file: &Path,
    arguments: &EvalArguments,
    truth: &[TruthRow],
) -> anyhow::Result<RotationEvaluation> {
    let rows: Vec<RotationRow> = read(file)?;
    let known = match (&arguments.gyro, &arguments.truth) {
        (Some(gyro), _) => {
            let samples: Vec<ImuRow> = read(gyro)?;
            ensure!(
                samples.len() > 1,
                "{} has {} samples: there is nothing to compare with. Cure: give the gyroscope's \
                 samples of the same flight",
                gyro.display(),
                samples.len()
            );
            TrueRotation::of_gyroscope(samples)
        }
        (None, Some(truth_file)) => {
            share_a_frame(rows.iter().map(|row| row.frame), file, truth, truth_file)?;
            TrueRotation::of_truth(truth).with_context(|| {
                format!(
                    "{} does not say how the camera was turned (camera_qw and so on). Cure: record \
                     the truth of a simulated flight anew with flockeye up --truth, or give a \
                     recording's gyroscope with --gyro",
                    truth_file.display()
                )
            })?
        }
        (None, None) => anyhow::bail!(
            "there is nothing to compare {} with. Cure: give --truth of the same simulated flight, or \
             a recording's gyroscope with --gyro",
            file.display()
        ),
    };
    Ok(RotationEvaluation::of(&rows, known))
}

/// Refuses a recording that has no frame in common with the truth.
fn share_a_frame(
    recorded: impl Iterator<Item = u64> + Clone,
    recorded_file: &Path,
    truth: &[TruthRow],
    truth_file: &Path,
) -> anyhow::Result<()> {
    let frames = |numbers: &mut dyn Iterator<Item = u64>| {
        let numbers: Vec<u64> = numbers.collect();
        let (first, last) = (numbers.iter().min(), numbers.iter().max());
        format!("{} to {}", first.unwrap_or(&0), last.unwrap_or(&0))
    };
    let known: BTreeSet<u64> = truth.iter().map(|row| row.frame).collect();
    ensure!(
        recorded.clone().next().is_none() || recorded.clone().any(|frame| known.contains(&frame)),
        "{} (frames {}) and {} (frames {}) share no frame. Cure: give what was recorded and the truth \
         of the same flight",
        recorded_file.display(),
        frames(&mut recorded.clone()),
        truth_file.display(),
        frames(&mut truth.iter().map(|row| row.frame)),
    );
    Ok(())
}
