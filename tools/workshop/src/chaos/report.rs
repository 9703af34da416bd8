//! The effects of disturbances on a pipeline.

use std::collections::{BTreeMap, VecDeque};
use std::fmt;
use std::path::Path;

use flockeye_cli::text_table::TextTable;
use flockeye_contract::{BodyTruth, FrameStamp, Pose, Track, TrackHeader, TruthHeader};
use flockeye_geometry::statistics::{median, quantile};
use flockeye_runtime::instance::Instance;
use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use serde::Serialize;

use super::disturbance::{Disturbance, DisturbanceKind};

/// Largest median time from a SIGKILL to a pose in a frame that was exposed later.
pub(crate) const MEDIAN_RECOVERY_MS: f64 = 250.0;
/// Largest time to the next pose in the worst case, also after all other disturbances.
pub(crate) const WORST_RECOVERY_MS: f64 = 2000.0;
/// Least errors of a wrong pose. Its error must also exceed five standard deviations.
const WRONG_M: f64 = 0.1;
const WRONG_RAD: f64 = 0.1745;
/// Frames whose truth is kept until their tracks come.
const TRUTH_FRAMES: usize = 256;

/// The effect of one disturbance.
#[derive(Debug, Clone, PartialEq, Serialize)]
struct DisturbanceOutcome {
    kind: DisturbanceKind,
    worker: String,
    struck_ns: i64,
    /// Time until a neighbour was measured in a later frame, milliseconds.
    recovery_ms: Option<f64>,
    /// The reason why the disturbance failed, such as a refused swap.
    failure: Option<String>,
}

/// The effects of disturbances on a pipeline.
#[derive(Debug, Clone, Default, Serialize)]
pub(crate) struct ChaosReport {
    outcomes: Vec<DisturbanceOutcome>,
    /// Number of frames that ended.
    frames: u64,
    /// Number of frames between them that did not end.
    frames_lost: u64,
    /// Largest number of consecutive lost frames.
    longest_gap: u64,
    /// Number of measured poses.
    poses: u64,
    /// Number of poses with a large error.
    wrong_poses: u64,
    /// Number of poses that were sent twice.
    double_poses: u64,
    /// Number of tracks that were lost and began again.
    tracks_broken: u64,
    /// Number of files in shared memory at the beginning and at the end.
    shared_files: [usize; 2],
    /// Bytes in shared memory at the beginning and at the end.
    shared_bytes: [u64; 2],
    #[serde(skip)]
    newest: Option<FrameStamp>,
    #[serde(skip)]
    track_ids: BTreeMap<String, u32>,
    #[serde(skip)]
    told: VecDeque<(FrameStamp, u32)>,
    #[serde(skip)]
    truths: VecDeque<(FrameStamp, Vec<BodyTruth>)>,
}

impl ChaosReport {
    /// Resets the counts, and measures the pipeline's shared memory.
    pub(crate) fn begin(&mut self, instance: &Instance) {
        let Self { newest, track_ids, told, truths, .. } = std::mem::take(self);
        *self = Self { newest, track_ids, told, truths, ..Self::default() };
        (self.shared_files[0], self.shared_bytes[0]) = shared_memory(instance);
    }

    /// Measures the pipeline's shared memory at the end.
    pub(crate) fn end(&mut self, instance: &Instance) {
        (self.shared_files[1], self.shared_bytes[1]) = shared_memory(instance);
    }

    /// Whether any neighbour was measured.
    pub(crate) fn has_poses(&self) -> bool {
        self.poses > 0
    }

    /// Notes the beginning of a disturbance.
    pub(crate) fn strike(&mut self, disturbance: &Disturbance, now_ns: i64) {
        self.outcomes.push(DisturbanceOutcome {
            kind: disturbance.kind,
            worker: disturbance.worker.to_string(),
            struck_ns: now_ns,
            recovery_ms: None,
            failure: None,
        });
    }

    /// Notes that the last disturbance failed.
    pub(crate) fn note_failure(&mut self, failure: String) {
        if let Some(last) = self.outcomes.last_mut() {
            last.failure = Some(failure);
        }
    }

    /// Whether a pose was measured in a frame after the last disturbance.
    pub(crate) fn has_recovered(&self) -> bool {
        self.outcomes.last().is_none_or(|last| last.recovery_ms.is_some())
    }

    /// The effect of the last disturbance as text.
    pub(crate) fn last_line(&self) -> String {
        let Some(last) = self.outcomes.last() else { return String::new() };
        let recovery = match last.recovery_ms {
            Some(ms) => format!("{ms:.0} ms until the next pose"),
            None => "no pose after it".to_owned(),
        };
        let failure = last.failure.as_ref().map_or_else(String::new, |why| format!(" ({why})"));
        format!("{:<16} {:<5} {recovery}{failure}", last.worker, name(last.kind))
    }

    /// Takes the truth of a frame.
    pub(crate) fn truth(&mut self, header: &TruthHeader, bodies: &[BodyTruth]) {
        self.truths.push_back((header.stamp, bodies.to_vec()));
        if self.truths.len() > TRUTH_FRAMES {
            self.truths.pop_front();
        }
    }

    /// Takes the tracks of a frame that arrived at `now_ns`.
    pub(crate) fn tracks(&mut self, header: &TrackHeader, tracks: &[Track], now_ns: i64) {
        let stamp = header.stamp;
        for track in tracks {
            let key = (stamp, track.target);
            let is_double = self
                .told
                .iter()
                .any(|(of, target)| of.is_same_frame(&stamp) && *target == track.target);
            self.double_poses += u64::from(is_double);
            self.told.push_back(key);
            if self.told.len() > TRUTH_FRAMES {
                self.told.pop_front();
            }
            if !track.is_measured() {
                continue;
            }
            self.poses += 1;
            let id = self.track_ids.insert(track.name.to_string(), track.track_id);
            self.tracks_broken += u64::from(id.is_some_and(|id| id != track.track_id));
            self.wrong_poses += u64::from(self.is_wrong(&stamp, track));
            if let Some(last) = self.outcomes.last_mut()
                && last.recovery_ms.is_none()
                && stamp.exposure_ns > last.struck_ns
            {
                last.recovery_ms = Some((now_ns - last.struck_ns) as f64 * 1e-6);
            }
        }
        if header.is_last != 0 {
            self.frames += 1;
            if let Some(before) = self.newest.replace(stamp) {
                let gap = stamp.skipped_since(&before);
                self.frames_lost += gap;
                self.longest_gap = self.longest_gap.max(gap);
            }
        }
    }

    fn is_wrong(&self, stamp: &FrameStamp, track: &Track) -> bool {
        let truth = self.truths.iter().rev().find(|(of, _)| of.is_same_frame(stamp));
        let body = truth.and_then(|(_, bodies)| bodies.iter().find(|body| body.name == track.name));
        body.is_some_and(|body| {
            let [seen, right] = [&track.observer_from_target, &body.observer_from_target];
            let off_m = (Vector3::from(seen.position) - Vector3::from(right.position)).norm();
            let turn =
                |pose: &Pose| UnitQuaternion::new_normalize(Quaternion::from(pose.orientation));
            let off_rad = turn(seen).angle_to(&turn(right));
            let sigma = |diagonal: [usize; 3]| {
                diagonal.map(|at| track.covariance[at]).iter().sum::<f64>().max(0.0).sqrt()
            };
            off_m > WRONG_M.max(5.0 * sigma([0, 7, 14]))
                || off_rad > WRONG_RAD.max(5.0 * sigma([21, 28, 35]))
        })
    }

    /// Recovery times of the disturbances with `is_meant`, rising, milliseconds; infinite without a
    /// recovery.
    fn recoveries(&self, is_meant: impl Fn(&DisturbanceOutcome) -> bool) -> Vec<f64> {
        let meant = self.outcomes.iter().filter(|outcome| is_meant(outcome));
        let mut rising: Vec<f64> =
            meant.map(|outcome| outcome.recovery_ms.unwrap_or(f64::INFINITY)).collect();
        rising.sort_by(f64::total_cmp);
        rising
    }

    /// The limits that are exceeded, as texts.
    pub(crate) fn broken_limits(&self) -> Vec<String> {
        let mut broken = Vec::new();
        let kills = self.recoveries(|outcome| outcome.kind == DisturbanceKind::Kill);
        if let Some(ms) = median(&kills).filter(|&ms| ms > MEDIAN_RECOVERY_MS) {
            broken.push(format!(
                "after SIGKILL the next pose took {ms:.0} ms in the median, {MEDIAN_RECOVERY_MS} may be"
            ));
        }
        // A swap is excluded: it takes time by design, and lost frames show its cost.
        let all = self.recoveries(|outcome| outcome.kind != DisturbanceKind::Swap);
        if let Some(&ms) = all.last().filter(|&&ms| ms > WORST_RECOVERY_MS) {
            broken.push(format!(
                "the next pose took {ms:.0} ms in the worst case, {WORST_RECOVERY_MS} may be"
            ));
        }
        for (count, what) in
            [(self.wrong_poses, "wrong poses"), (self.double_poses, "poses came twice")]
        {
            if count > 0 {
                broken.push(format!("{count} {what}"));
            }
        }
        if self.shared_files[1] > self.shared_files[0]
            || self.shared_bytes[1] > self.shared_bytes[0]
        {
            broken.push(format!(
                "shared memory leaked: {} files of {} bytes at the beginning, {} of {} at the end",
                self.shared_files[0],
                self.shared_bytes[0],
                self.shared_files[1],
                self.shared_bytes[1]
            ));
        }
        broken
    }
}

impl fmt::Display for ChaosReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let titles = ["worker", "what", "times", "failed", "median ms", "95 % ms", "worst ms"];
        let mut table = TextTable::new(2, &titles);
        let mut groups: Vec<(DisturbanceKind, &str)> =
            self.outcomes.iter().map(|outcome| (outcome.kind, outcome.worker.as_str())).collect();
        groups.sort_unstable();
        groups.dedup();
        let every = [
            DisturbanceKind::Kill,
            DisturbanceKind::Stop,
            DisturbanceKind::Slow,
            DisturbanceKind::Swap,
        ]
        .map(|kind| (kind, "all"));
        for (kind, worker) in groups.into_iter().chain(every) {
            let is_meant = |outcome: &DisturbanceOutcome| {
                outcome.kind == kind && (worker == "all" || outcome.worker == worker)
            };
            let recoveries = self.recoveries(is_meant);
            if recoveries.is_empty() {
                continue;
            }
            let failed = self
                .outcomes
                .iter()
                .filter(|outcome| is_meant(outcome) && outcome.failure.is_some())
                .count();
            let ms = |value: Option<f64>| value.map_or_else(String::new, |ms| format!("{ms:.0}"));
            table.row([
                worker.to_owned(),
                name(kind).to_owned(),
                recoveries.len().to_string(),
                failed.to_string(),
                ms(median(&recoveries)),
                ms(quantile(&recoveries, 0.95)),
                ms(recoveries.last().copied()),
            ]);
        }
        writeln!(f, "{}", table.text())?;
        write!(
            f,
            "{} frames, {} lost between them, {} in a row at most; {} poses, {} wrong, {} twice; {} tracks began anew; shared \
             memory {:.1} MB in {} files, {:.1} MB in {} at the end",
            self.frames,
            self.frames_lost,
            self.longest_gap,
            self.poses,
            self.wrong_poses,
            self.double_poses,
            self.tracks_broken,
            self.shared_bytes[0] as f64 / 1e6,
            self.shared_files[0],
            self.shared_bytes[1] as f64 / 1e6,
            self.shared_files[1]
        )
    }
}

fn name(kind: DisturbanceKind) -> &'static str {
    match kind {
        DisturbanceKind::Kill => "kill",
        DisturbanceKind::Stop => "stop",
        DisturbanceKind::Slow => "slow",
        DisturbanceKind::Swap => "swap",
    }
}

/// Numbers of an instance's files in shared memory, and of their bytes.
fn shared_memory(instance: &Instance) -> (usize, u64) {
    let files = instance.shared_memory();
    let size = |path: &Path| std::fs::metadata(path).map_or(0, |found| found.len());
    (files.len(), files.iter().map(|path| size(path)).sum())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use flockeye_contract::MeasuredBy;
    use std::time::Duration;

    const MS: i64 = 1_000_000;

    fn header(sequence: u64, exposure_ms: i64) -> TrackHeader {
        let stamp = FrameStamp { sequence, exposure_ns: exposure_ms * MS, ..FrameStamp::default() };
        TrackHeader { stamp, generation: 0, is_last: 1 }
    }

    fn measured(track_id: u32) -> Track {
        Track {
            measured_by: MeasuredBy::Aligned.code(),
            track_id,
            name: "alpha".into(),
            observer_from_target: Pose::default(),
            ..bytemuck::Zeroable::zeroed()
        }
    }

    fn kill() -> Disturbance {
        let worker = "fusion".parse().unwrap();
        Disturbance { kind: DisturbanceKind::Kill, worker, pid: 7, lasts: Duration::ZERO }
    }

    #[test]
    fn recovery_counts_from_the_blow_to_a_pose_of_a_later_frame() {
        let mut report = ChaosReport::default();
        report.tracks(&header(0, 10), &[measured(1)], 15 * MS);
        report.strike(&kill(), 20 * MS);
        // This frame was exposed before.
        report.tracks(&header(1, 19), &[measured(1)], 24 * MS);
        assert!(!report.has_recovered());
        report.tracks(&header(4, 120), &[measured(2)], 140 * MS);
        assert!(report.has_recovered());
        assert!(
            report.last_line().contains("120 ms until the next pose"),
            "{}",
            report.last_line()
        );
        assert_eq!((report.frames, report.frames_lost, report.tracks_broken), (3, 2, 1));
        assert_eq!(report.broken_limits(), Vec::<String>::new());
    }

    #[test]
    fn what_is_worse_than_it_may_be_is_said() {
        let mut report = ChaosReport::default();
        report.strike(&kill(), 0);
        let twice = header(1, 400);
        report.tracks(&twice, &[measured(1)], 2500 * MS);
        let body = BodyTruth { name: "alpha".into(), ..BodyTruth::default() };
        report.truth(&TruthHeader { stamp: twice.stamp, ..TruthHeader::default() }, &[body]);
        let mut far = measured(1);
        far.observer_from_target.position = [0.2, 0.0, 0.0];
        report.tracks(&twice, &[far], 2600 * MS);
        // Turned by 20 degrees about z.
        let mut turned = measured(1);
        turned.observer_from_target.orientation = [0.0, 0.0, 0.174, 0.985];
        report.tracks(&twice, &[turned], 2600 * MS);
        report.strike(&kill(), 3000 * MS);
        let broken = report.broken_limits().join("; ");
        for wanted in ["inf ms in the worst case", "2 wrong poses", "2 poses came twice"] {
            assert!(broken.contains(wanted), "{wanted:?} is missing in {broken}");
        }
        assert!(report.to_string().contains("fusion"), "{report}");
    }
}
