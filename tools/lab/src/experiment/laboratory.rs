//! `flockeye experiment`: the paper's tables anew, and how consistent covariances are. Each flight is
//! the whole pipeline, lossless, in an instance of its own.

mod consistency;
mod partitions;
mod search;

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};

use anyhow::{Context, bail, ensure};
use flockeye_runtime::config::Pipeline;
use serde::Serialize;

use crate::cli::{Comparison, Configuration, Experiment, ExperimentKind, FlowArgument};
use crate::evaluation::Evaluation;
use crate::record::{TruthRow, read};
use crate::screen::Screen;
use crate::up::{self, Errand, Flown};

/// Runs an experiment.
///
/// # Errors
/// The configuration is wrong, there is no truth, or a flight fails.
pub fn run(arguments: &Experiment) -> anyhow::Result<()> {
    match &arguments.kind {
        ExperimentKind::Partitions(arguments) => {
            show(&partitions::work_out(arguments)?, arguments.json)
        }
        ExperimentKind::Search(arguments) => show(&search::work_out(arguments)?, arguments.json),
        ExperimentKind::Consistency(arguments) => {
            show(&consistency::work_out(arguments)?, arguments.json)
        }
    }
}

fn show<T: Serialize + ToString>(found: &T, json: bool) -> anyhow::Result<()> {
    let text = if json { serde_json::to_string(found)? } else { found.to_string() };
    Screen::new().line(&text);
    Ok(())
}

/// What flights one after another have in common.
struct Laboratory<'a> {
    configuration: &'a Configuration,
    /// Settings that the user's go before.
    usual: Vec<String>,
    frames: u64,
    stopping: Arc<AtomicBool>,
    screen: Screen,
}

impl<'a> Laboratory<'a> {
    fn new(
        configuration: &'a Configuration,
        usual: &[&str],
        frames: u64,
        json: bool,
    ) -> anyhow::Result<Self> {
        ensure!(
            configuration.flow != Some(FlowArgument::Latest),
            "an experiment works on every frame. Cure: leave out --flow latest"
        );
        Ok(Self {
            configuration,
            usual: usual.iter().map(|setting| (*setting).to_owned()).collect(),
            frames,
            stopping: up::stopped_by_signals()?,
            screen: if json { Screen::muted() } else { Screen::new() },
        })
    }

    /// The configuration with settings that go before the user's.
    fn pipeline(&self, fixed: &[String]) -> anyhow::Result<Pipeline> {
        static FLIGHTS: AtomicU32 = AtomicU32::new(0);
        let flight = FLIGHTS.fetch_add(1, Ordering::Relaxed);
        let own = [
            "flow=lossless".to_owned(),
            "gateway.enabled=false".to_owned(),
            format!("instance=x{}-{flight}", std::process::id()),
            format!("simulator.frames={}", self.frames),
        ];
        self.configuration.load_between(&self.usual, &[&own, fixed].concat())
    }

    /// Flies once; `what` says which flight it is.
    fn fly(&mut self, what: &str, pipeline: &Pipeline) -> anyhow::Result<Flown> {
        if self.screen.is_live() {
            self.screen.table(&format!("{what} ..."));
        }
        let errand = Errand { frames: Some(self.frames), keeps: true, ..Errand::default() };
        let mut log = Screen::muted();
        let flown = up::fly(pipeline, &errand, &mut log, &self.stopping)
            .with_context(|| format!("{}{what}", log.kept()))?;
        if self.stopping.load(Ordering::Relaxed) {
            bail!("stopped");
        }
        ensure!(!flown.frames.is_empty(), "{}{what}: no frame was worked on", log.kept());
        Ok(flown)
    }
}

/// What one way of doing it came to.
#[derive(Debug, Clone, PartialEq, Serialize)]
struct Outcome {
    /// Frames worked on.
    frames: usize,
    /// In a second of the pipeline's work alone: from each frame's publication to its end.
    frames_per_s: f64,
    /// In a second of the clock, with what the source needs: decoding, or simulating.
    wall_frames_per_s: Option<f64>,
    /// Bodies to be seen: localisable, two markers wholly visible.
    eligible: usize,
    /// Those that were measured.
    captured: usize,
    /// Their share.
    share: Option<f64>,
    /// The share that is left at the source's own rate if each frame that comes while another is
    /// worked on is lost: `share` times the part of the frames that there is time for.
    share_in_real_time: Option<f64>,
    /// Mean position error within 1.5 m, the paper's range, centimetres.
    mean_error_cm: Option<f64>,
    /// Median position error within 1.5 m, centimetres.
    median_error_cm: Option<f64>,
    /// Measurements that are wrong by more than 10 cm or 10 degrees, or of who is not there.
    false_poses: usize,
}

impl Outcome {
    /// Of a flight and the truth of its frames.
    fn of(flown: &Flown, truth: &[TruthRow]) -> anyhow::Result<Self> {
        let truth: Vec<TruthRow> =
            truth.iter().filter(|row| flown.frames.contains(&row.frame)).cloned().collect();
        ensure!(
            !truth.is_empty(),
            "the truth says nothing of any of the {} frames that were worked on. Cure: give the \
             truth of the same recording",
            flown.frames.len()
        );
        let evaluation = Evaluation::of(&flown.poses, &truth);
        let all = evaluation.everything().context("no range holds everything")?;
        let near = evaluation.within_1_5_m().and_then(|bin| bin.published);
        let frames = flown.frames.len();
        let frames_per_s = frames as f64 / flown.work_s;
        let part = |rate: f64| (frames_per_s / rate).min(1.0);
        Ok(Self {
            frames,
            frames_per_s,
            wall_frames_per_s: (frames > 1).then(|| (frames - 1) as f64 / flown.ends_s),
            eligible: all.eligible,
            captured: all.measured,
            share: all.share(),
            share_in_real_time: all.share().zip(rate(&truth)).map(|(share, r)| share * part(r)),
            mean_error_cm: near.map(|errors| errors.position_mm.mean / 10.0),
            median_error_cm: near.map(|errors| errors.position_mm.median / 10.0),
            false_poses: evaluation.false_poses,
        })
    }

    /// Its columns, after what says which way it is.
    fn columns(&self) -> String {
        let number =
            |x: Option<f64>, digits: usize| x.map_or("-".to_owned(), |x| format!("{x:.digits$}"));
        let percent = |x: Option<f64>| x.map_or("-".to_owned(), |x| format!("{:.1} %", 100.0 * x));
        format!(
            "{:>8.1} {:>8} {:>9} {:>9} {:>8} {:>8} {:>8} {:>9} {:>6}",
            self.frames_per_s,
            number(self.wall_frames_per_s, 1),
            number(self.mean_error_cm, 2),
            number(self.median_error_cm, 2),
            self.captured,
            self.eligible,
            percent(self.share),
            percent(self.share_in_real_time),
            self.false_poses
        )
    }
}

/// Titles of [`Outcome::columns`].
fn titles() -> String {
    format!(
        "{:>8} {:>8} {:>9} {:>9} {:>8} {:>8} {:>8} {:>9} {:>6}",
        "FpS", "wall", "error cm", "median", "captured", "of", "share", "real time", "false"
    )
}

/// What the columns mean.
const LEGEND: &str = "\
FpS: frames a second of the pipeline's work alone, from a frame's publication to its end; wall: with the source's decoding or simulating
error: of the published position within 1.5 m, mean and median; captured: localisable bodies with two markers wholly visible that were measured, at any distance
real time: the share that would be left at the source's own rate, if frames that come while another is worked on are lost";

/// Frames a second of a recording, from the times between neighbouring frames.
fn rate(truth: &[TruthRow]) -> Option<f64> {
    let first = truth.iter().min_by_key(|row| row.frame)?;
    let last = truth.iter().max_by_key(|row| row.frame)?;
    let seconds = last.t_s - first.t_s;
    (seconds > 0.0).then(|| (last.frame - first.frame) as f64 / seconds)
}

/// The truth of a recording, if one is given: a simulated flight has its own.
fn given_truth(arguments: &Comparison) -> anyhow::Result<Option<Vec<TruthRow>>> {
    let pipeline = arguments.configuration.load()?;
    let is_simulated = pipeline.source_stage() == "simulator";
    match (&arguments.truth, is_simulated) {
        (Some(_), true) => bail!("a simulated flight has its own truth. Cure: leave out --truth"),
        (None, false) => bail!(
            "'{}' has no truth of its own. Cure: give it with --truth FILE.csv, or simulate \
             (--source sim)",
            pipeline.source.input
        ),
        (Some(file), false) => {
            let truth: Vec<TruthRow> = read(Path::new(file))?;
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
    fn an_outcome_counts_the_frames_that_were_worked_on() {
        let at = |x: f64| Vector3::new(x, 0.0, 0.0);
        let flown = Flown {
            poses: vec![
                pose_at(0, at(1.01), TrackState::Confirmed),
                pose_at(1, at(1.03), TrackState::Confirmed),
                pose_at(2, at(2.01), TrackState::Coasting),
            ],
            frames: (0..4).collect(),
            work_s: 0.2,
            ends_s: 0.3,
            ..Flown::default()
        };
        let truth = [1.0, 1.0, 2.0, 2.0, 2.0].iter().zip(0..).map(|(x, k)| truth_at(k, at(*x)));
        let truth: Vec<TruthRow> = truth.collect();
        let outcome = Outcome::of(&flown, &truth).expect("there is truth");
        assert_eq!((outcome.frames, outcome.eligible, outcome.captured), (4, 4, 2));
        assert!((outcome.frames_per_s - 20.0).abs() < 1e-9);
        assert!((outcome.wall_frames_per_s.expect("four") - 10.0).abs() < 1e-9);
        assert!((outcome.mean_error_cm.expect("two") - 2.0).abs() < 1e-9);
        assert!((outcome.median_error_cm.expect("two") - 2.0).abs() < 1e-9);
        assert_eq!(outcome.share, Some(0.5));
        // 20 of the 30 frames of a second can be worked on.
        assert!((outcome.share_in_real_time.expect("a rate") - 1.0 / 3.0).abs() < 1e-9);
        assert!(Outcome::of(&flown, &[truth_at(9, at(1.0))]).is_err());
    }
}
