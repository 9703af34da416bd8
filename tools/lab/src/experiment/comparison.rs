//! Common parts of the experiments that compare ways of searching.

use std::path::PathBuf;

use anyhow::{Context, bail, ensure};
use clap::Args;
use flockeye_cli::Configuration;
use flockeye_contract::StageName;
use flockeye_tables::{TruthRow, read};
use serde::Serialize;

use super::laboratory::FlightRecord;
use crate::evaluation::Evaluation;

/// Arguments of the experiments that compare.
#[derive(Debug, Args)]
pub(crate) struct ComparisonArguments {
    /// Which configuration. Its flow is lossless.
    #[command(flatten)]
    pub configuration: Configuration,
    /// The truth of a recording; a simulated flight has its own.
    #[arg(long, value_name = "FILE.csv")]
    pub truth: Option<PathBuf>,
    /// Frames of each flight, at most.
    #[arg(long, default_value_t = 300, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    pub frames: u64,
    /// One JSON object instead of a table.
    #[arg(long)]
    pub json: bool,
}

/// The results beside the paper's results.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct BesidePaper<Row, PaperRow: 'static> {
    pub(super) rows: Vec<Row>,
    pub(super) paper: &'static [PaperRow],
}

/// The result of one flight.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct FlightOutcome {
    /// Number of frames that ended.
    frames: usize,
    /// Frames per second of the pipeline's work: from each frame's publication to its end.
    frames_per_s: f64,
    /// Frames per second of wall time, which includes decoding or simulation by the source.
    wall_frames_per_s: Option<f64>,
    /// Eligible bodies: localisable, with two markers wholly visible.
    eligible: usize,
    /// Eligible bodies that were measured.
    captured: usize,
    /// Measured share of the eligible bodies.
    share: Option<f64>,
    /// Expected share at the source's own rate, if frames are lost while another is processed. It
    /// is `share` times the part of the frames that can be processed.
    share_in_real_time: Option<f64>,
    /// Mean position error within 1.5 m, the paper's range, centimetres.
    mean_error_cm: Option<f64>,
    /// Median position error within 1.5 m, centimetres.
    median_error_cm: Option<f64>,
    /// Number of measurements with an error over 10 cm or 10 degrees, or of a body that is not in
    /// view.
    false_poses: usize,
}

impl FlightOutcome {
    /// Compares a flight with the truth of its frames.
    pub(super) fn of(flight: &FlightRecord, truth: &[TruthRow]) -> anyhow::Result<Self> {
        let truth: Vec<TruthRow> =
            truth.iter().filter(|row| flight.frames.contains(&row.frame)).cloned().collect();
        ensure!(
            !truth.is_empty(),
            "the truth has none of the {} frames that ended. Cure: give the \
             truth of the same recording",
            flight.frames.len()
        );
        let evaluation = Evaluation::of(&flight.poses, &truth);
        let all = evaluation.everything().context("no range holds everything")?;
        let near = evaluation.within_1_5_m().and_then(|bin| bin.published);
        let frames = flight.frames.len();
        let frames_per_s = frames as f64 / flight.work_s;
        let part = |rate: f64| (frames_per_s / rate).min(1.0);
        Ok(Self {
            frames,
            frames_per_s,
            wall_frames_per_s: (frames > 1).then(|| (frames - 1) as f64 / flight.ends_s),
            eligible: all.eligible,
            captured: all.measured,
            share: all.share(),
            share_in_real_time: all.share().zip(rate(&truth)).map(|(share, r)| share * part(r)),
            mean_error_cm: near.map(|errors| errors.position_mm.mean / 10.0),
            median_error_cm: near.map(|errors| errors.position_mm.median / 10.0),
            false_poses: evaluation.false_poses,
        })
    }

    /// The cells under [`TITLES`].
    pub(super) fn cells(&self) -> [String; 9] {
        let number =
            |x: Option<f64>, digits: usize| x.map_or("-".to_owned(), |x| format!("{x:.digits$}"));
        let percent = |x: Option<f64>| x.map_or("-".to_owned(), |x| format!("{:.1} %", 100.0 * x));
        [
            format!("{:.1}", self.frames_per_s),
            number(self.wall_frames_per_s, 1),
            number(self.mean_error_cm, 2),
            number(self.median_error_cm, 2),
            self.captured.to_string(),
            self.eligible.to_string(),
            percent(self.share),
            percent(self.share_in_real_time),
            self.false_poses.to_string(),
        ]
    }
}

/// The titles of [`FlightOutcome::cells`].
pub(super) const TITLES: [&str; 9] =
    ["FpS", "wall", "error cm", "median", "captured", "of", "share", "real time", "false"];

/// Meaning of the columns.
pub(super) const LEGEND: &str = "\
FpS: frames a second of the pipeline's work alone, from a frame's publication to its end; wall: with the source's decoding or simulating
error: of the published position within 1.5 m, mean and median; captured: localisable bodies with two markers wholly visible that were measured, at any distance
real time: the share that would be left at the source's own rate, if frames that come while another is processed are lost";

/// Frames per second of a recording, from the times of its frames.
fn rate(truth: &[TruthRow]) -> Option<f64> {
    let first = truth.iter().min_by_key(|row| row.frame)?;
    let last = truth.iter().max_by_key(|row| row.frame)?;
    let seconds = last.t_s - first.t_s;
    (seconds > 0.0).then(|| (last.frame - first.frame) as f64 / seconds)
}

/// The given truth of a recording; `None` for a simulated flight, which has its own.
pub(super) fn given_truth(
    arguments: &ComparisonArguments,
) -> anyhow::Result<Option<Vec<TruthRow>>> {
    let pipeline = arguments.configuration.load()?;
    let is_simulated = pipeline.source.stage() == StageName::Simulator;
    match (&arguments.truth, is_simulated) {
        (Some(_), true) => bail!("a simulated flight has its own truth. Cure: leave out --truth"),
        (None, false) => bail!(
            "'{}' has no truth of its own. Cure: give it with --truth FILE.csv, or simulate \
             (--source sim)",
            pipeline.source.input
        ),
        (Some(file), false) => {
            let truth: Vec<TruthRow> = read(file)?;
            ensure!(!truth.is_empty(), "{} says nothing of any frame", file.display());
            Ok(Some(truth))
        }
        (None, true) => Ok(None),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::samples::{pose_at, truth_at};
    use flockeye_contract::TrackState;
    use nalgebra::Vector3;

    #[test]
    fn an_outcome_counts_the_frames_that_ended() {
        let at = |x: f64| Vector3::new(x, 0.0, 0.0);
        let flight = FlightRecord {
            poses: vec![
                pose_at(0, at(1.01), TrackState::Confirmed),
                pose_at(1, at(1.03), TrackState::Confirmed),
                pose_at(2, at(2.01), TrackState::Coasting),
            ],
            frames: (0..4).collect(),
            work_s: 0.2,
            ends_s: 0.3,
            ..FlightRecord::default()
        };
        let truth = [1.0, 1.0, 2.0, 2.0, 2.0].iter().zip(0..).map(|(x, k)| truth_at(k, at(*x)));
        let truth: Vec<TruthRow> = truth.collect();
        let outcome = FlightOutcome::of(&flight, &truth).expect("there is truth");
        assert_eq!((outcome.frames, outcome.eligible, outcome.captured), (4, 4, 2));
        assert!((outcome.frames_per_s - 20.0).abs() < 1e-9);
        assert!((outcome.wall_frames_per_s.expect("four") - 10.0).abs() < 1e-9);
        assert!((outcome.mean_error_cm.expect("two") - 2.0).abs() < 1e-9);
        assert!((outcome.median_error_cm.expect("two") - 2.0).abs() < 1e-9);
        assert_eq!(outcome.share, Some(0.5));
        // 20 of the 30 frames of a second can be processed.
        assert!((outcome.share_in_real_time.expect("a rate") - 1.0 / 3.0).abs() < 1e-9);
        assert!(FlightOutcome::of(&flight, &[truth_at(9, at(1.0))]).is_err());
    }
}
