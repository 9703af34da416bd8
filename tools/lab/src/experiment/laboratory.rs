//! Runs flights one after another, each a lossless run of the whole pipeline.

use std::collections::BTreeSet;
use std::ffi::OsString;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};

use anyhow::{Context, bail, ensure};
use flockeye_cli::{Configuration, Screen, signals};
use flockeye_config::{Pipeline, Profile};
use flockeye_tables::{FrameTimes, PoseRow, TruthRow, read};

use crate::up_process;

/// The common settings of an experiment's flights.
pub(super) struct Laboratory {
    configuration: Configuration,
    /// Settings with lower priority than the user's.
    defaults: Vec<String>,
    frames: u64,
    stopping: Arc<AtomicBool>,
    screen: Screen,
}

/// The recorded data of a flight.
#[derive(Debug, Clone, Default)]
pub(super) struct FlightRecord {
    /// The poses of all frames that ended.
    pub(super) poses: Vec<PoseRow>,
    /// The truth, if the source has one. It includes frames that did not end.
    pub(super) truth: Vec<TruthRow>,
    /// Numbers of the frames that ended.
    pub(super) frames: BTreeSet<u64>,
    /// Sum of the times from each frame's publication to its end, seconds.
    pub(super) work_s: f64,
    /// Time from the end of the first frame to the end of the last one, seconds.
    pub(super) ends_s: f64,
}

impl FlightRecord {
    fn new(mut poses: Vec<PoseRow>, truth: Vec<TruthRow>, times: &[FrameTimes]) -> Self {
        let frames: BTreeSet<u64> = times.iter().map(|times| times.frame).collect();
        poses.retain(|row| frames.contains(&row.frame));
        let ends = times.first().zip(times.last());
        let ends_ns = ends.map_or(0, |(first, last)| last.ended_ns.saturating_sub(first.ended_ns));
        let work_s = times.iter().map(FrameTimes::work_s).sum();
        Self { poses, truth, frames, work_s, ends_s: ends_ns as f64 * 1e-9 }
    }
}

impl Laboratory {
    /// Prepares flights of at most `frames` frames. Progress is shown unless the result is JSON.
    pub(super) fn new(
        configuration: &Configuration,
        defaults: &[&str],
        frames: u64,
        json: bool,
    ) -> anyhow::Result<Self> {
        ensure!(
            configuration.flow.as_deref() != Some("latest")
                && configuration.profile.as_deref() != Some(Profile::Flight.name()),
            "an experiment works on every frame. Cure: leave out --profile flight"
        );
        let defaults: Vec<String> = defaults.iter().map(|setting| (*setting).to_owned()).collect();
        Ok(Self {
            configuration: configuration.clone().with_every_frame(&defaults)?,
            defaults,
            frames,
            stopping: signals::stop_flag()?,
            screen: if json { Screen::muted() } else { Screen::new() },
        })
    }

    /// The configuration of a flight, and its arguments for `flockeye up`. The settings `fixed`
    /// override the user's.
    pub(super) fn plan(&self, fixed: &[String]) -> anyhow::Result<(Pipeline, Vec<OsString>)> {
        static FLIGHTS: AtomicU32 = AtomicU32::new(0);
        let flight = FLIGHTS.fetch_add(1, Ordering::Relaxed);
        let own = [
            "gateway.enabled=false".to_owned(),
            "recording.folder=null".to_owned(),
            format!("instance=x{}-{flight}", std::process::id()),
            format!("simulator.frames={}", self.frames),
        ];
        let fixed = [&own, fixed].concat();
        let pipeline = self.configuration.load_with(&self.defaults, &fixed)?;
        Ok((pipeline, self.configuration.to_arguments(&self.defaults, &fixed)))
    }

    /// Runs a flight with planned arguments. `what` describes it in messages.
    pub(super) fn fly(&mut self, what: &str, plan: &[OsString]) -> anyhow::Result<FlightRecord> {
        if self.screen.is_live() {
            self.screen.table(&format!("{what} ..."));
        }
        let folder = tempfile::tempdir().context("cannot make a temporary folder")?;
        let [poses, truth, times] =
            ["poses.csv", "truth.csv", "frame-times.csv"].map(|name| folder.path().join(name));
        let mut arguments: Vec<OsString> = vec!["--frames".into(), self.frames.to_string().into()];
        for (option, file) in [("--poses", &poses), ("--truth", &truth), ("--frame-times", &times)]
        {
            arguments.extend([option.into(), file.into()]);
        }
        arguments.extend_from_slice(plan);
        let log = up_process::run_quietly(what, &arguments, &self.stopping)?;
        if self.stopping.load(Ordering::Relaxed) {
            bail!("stopped");
        }
        let times: Vec<FrameTimes> = read(&times)?;
        ensure!(!times.is_empty(), "{log}{what}: no frame was searched to its end");
        Ok(FlightRecord::new(read(&poses)?, read(&truth)?, &times))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::samples::pose_at;
    use flockeye_contract::TrackState;
    use nalgebra::Vector3;

    #[test]
    fn a_record_has_the_frames_that_ended_and_their_times() {
        let pose = |frame| pose_at(frame, Vector3::x(), TrackState::Confirmed);
        let times = |frame, published_ns, ended_ns| FrameTimes { frame, published_ns, ended_ns };
        let times =
            [times(0, 1_000_000_000, 1_500_000_000), times(2, 2_000_000_000, 2_250_000_000)];
        let record = FlightRecord::new([0, 1, 2].map(pose).into(), Vec::new(), &times);
        let frames: Vec<u64> = record.poses.iter().map(|pose| pose.frame).collect();
        assert_eq!(frames, [0, 2]);
        assert_eq!(record.frames, BTreeSet::from([0, 2]));
        assert!((record.work_s - 0.75).abs() < 1e-12 && (record.ends_s - 0.75).abs() < 1e-12);
        assert!(FlightRecord::new(Vec::new(), Vec::new(), &[]).frames.is_empty());
    }
}
