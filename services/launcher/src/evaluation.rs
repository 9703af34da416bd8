//! Poses against the truth: how many of the localisable bodies were measured, and how well.

use std::collections::BTreeMap;
use std::fmt;

use serde::Serialize;

use crate::cli::Eval;
use crate::record::{self, PoseRow, TruthRow};
use crate::screen::Screen;

/// Borders of the distance bins, metres.
const BINS_M: [f64; 6] = [0.0, 1.0, 1.5, 2.2, 3.0, 4.0];

/// A pose that is wrong by more than this is a false one, metres.
const FALSE_POSE_M: f64 = 0.3;

/// One comparison of a measured pose with the truth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseError {
    /// Between the positions, metres.
    pub position_m: f64,
    /// Between the orientations, degrees.
    pub rotation_deg: f64,
}

impl PoseError {
    /// Compares a pose with the truth.
    pub fn of(pose: &PoseRow, truth: &TruthRow) -> Self {
        Self {
            position_m: (pose.position() - truth.position()).norm(),
            rotation_deg: pose.orientation().angle_to(&truth.orientation()).to_degrees(),
        }
    }
}

/// What came out in one range of distances.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Bin {
    /// From this distance, metres.
    pub from_m: f64,
    /// To this distance, metres.
    pub to_m: f64,
    /// Bodies with two or more markers wholly visible and localisable.
    pub eligible: usize,
    /// Those that were measured in that frame.
    pub measured: usize,
    /// Their position error's median, millimetres.
    pub median_mm: Option<f64>,
    /// Its 95 % quantile.
    pub p95_mm: Option<f64>,
    /// The worst.
    pub worst_mm: Option<f64>,
    /// Their rotation error's median, degrees.
    pub rotation_median_deg: Option<f64>,
}

/// What came out.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Evaluation {
    /// By distance; the last but one is everything within 1.5 m, the last everything.
    pub bins: Vec<Bin>,
    /// Measured poses, eligible or not.
    pub measured: usize,
    /// Poses that were predicted only.
    pub coasted: usize,
    /// Measured poses that are wrong by more than 30 cm, or of a body that is not there.
    pub false_poses: usize,
    /// Where the false ones are: frame, target, error in metres (none: not there).
    pub false_at: Vec<(u64, String, Option<f64>)>,
}

impl Evaluation {
    /// Compares poses with the truth, row by row of frame and body.
    pub fn of(poses: &[PoseRow], truth: &[TruthRow]) -> Self {
        let measured: BTreeMap<(u64, &str), &PoseRow> = poses
            .iter()
            .filter(|pose| pose.is_measured())
            .map(|pose| ((pose.frame, pose.target.as_str()), pose))
            .collect();
        let truths: BTreeMap<(u64, &str), &TruthRow> =
            truth.iter().map(|row| ((row.frame, row.body.as_str()), row)).collect();
        let false_at: Vec<_> = measured
            .iter()
            .filter_map(|(key, pose)| match truths.get(key) {
                None => Some((key.0, key.1.to_owned(), None)),
                Some(truth) => {
                    let error = PoseError::of(pose, truth).position_m;
                    (error > FALSE_POSE_M).then(|| (key.0, key.1.to_owned(), Some(error)))
                }
            })
            .collect();
        let ranges = BINS_M.windows(2).map(|pair| (pair[0], pair[1]));
        let bins = ranges.chain([(0.0, 1.5), (0.0, f64::MAX)]).map(|(from_m, to_m)| {
            let eligible: Vec<_> = truths
                .iter()
                .filter(|(_, row)| row.localisable == 1 && row.n_markers_vis90 >= 2)
                .filter(|(_, row)| (from_m..to_m).contains(&row.dist_m))
                .collect();
            let errors: Vec<_> = eligible
                .iter()
                .filter_map(|(key, row)| measured.get(key).map(|pose| PoseError::of(pose, row)))
                .collect();
            let mut positions: Vec<_> = errors.iter().map(|error| error.position_m * 1e3).collect();
            let mut rotations: Vec<_> = errors.iter().map(|error| error.rotation_deg).collect();
            positions.sort_by(f64::total_cmp);
            rotations.sort_by(f64::total_cmp);
            Bin {
                from_m,
                to_m,
                eligible: eligible.len(),
                measured: errors.len(),
                median_mm: quantile(&positions, 0.5),
                p95_mm: quantile(&positions, 0.95),
                worst_mm: positions.last().copied(),
                rotation_median_deg: quantile(&rotations, 0.5),
            }
        });
        Self {
            bins: bins.collect(),
            measured: measured.len(),
            coasted: poses.len() - poses.iter().filter(|pose| pose.is_measured()).count(),
            false_poses: false_at.len(),
            false_at,
        }
    }

    /// Everything within 1.5 m, the paper's range.
    pub fn within_1_5_m(&self) -> Option<&Bin> {
        self.bins.iter().find(|bin| bin.from_m == 0.0 && bin.to_m == 1.5)
    }
}

/// The value below which `share` of the rising `values` lie (nearest rank).
pub fn quantile(values: &[f64], share: f64) -> Option<f64> {
    let rank = (share * values.len() as f64).ceil() as usize;
    values.get(rank.saturating_sub(1)).copied()
}

impl fmt::Display for Evaluation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "{:<12} {:>9} {:>9} {:>7} {:>10} {:>9} {:>10} {:>10}",
            "distance m",
            "eligible",
            "measured",
            "share",
            "median mm",
            "95 % mm",
            "worst mm",
            "rotation °"
        )?;
        for bin in self.bins.iter().filter(|bin| bin.eligible > 0) {
            let range = if bin.to_m == f64::MAX {
                "all".to_owned()
            } else {
                format!("{:.1} - {:.1}", bin.from_m, bin.to_m)
            };
            let number = |x: Option<f64>| x.map_or("-".to_owned(), |x| format!("{x:.1}"));
            writeln!(
                f,
                "{range:<12} {:>9} {:>9} {:>5.1} % {:>10} {:>9} {:>10} {:>10}",
                bin.eligible,
                bin.measured,
                100.0 * bin.measured as f64 / bin.eligible as f64,
                number(bin.median_mm),
                number(bin.p95_mm),
                number(bin.worst_mm),
                bin.rotation_median_deg.map_or("-".to_owned(), |x| format!("{x:.2}")),
            )?;
        }
        write!(
            f,
            "{} poses measured, {} predicted only, {} false (wrong by more than 30 cm, or of a body that is not there)",
            self.measured, self.coasted, self.false_poses
        )?;
        for (frame, target, error) in self.false_at.iter().take(10) {
            let error =
                error.map_or("is not there".to_owned(), |error| format!("is off by {error:.2} m"));
            write!(f, "\n  frame {frame}: {target} {error}")?;
        }
        Ok(())
    }
}

/// `flockeye eval`.
///
/// # Errors
/// A file cannot be read.
pub fn run(arguments: &Eval) -> anyhow::Result<()> {
    let evaluation =
        Evaluation::of(&record::read(&arguments.poses)?, &record::read(&arguments.truth)?);
    if arguments.json {
        Screen::new().line(&serde_json::to_string(&evaluation)?);
    } else {
        Screen::new().line(&evaluation.to_string());
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockeye_contract::TrackState;

    fn pose(frame: u64, px: f64, state: TrackState) -> PoseRow {
        PoseRow {
            frame,
            stamp_s: 0.0,
            target: "alpha".into(),
            px,
            py: 0.0,
            pz: 0.0,
            qx: 0.0,
            qy: 0.0,
            qz: 0.0,
            qw: 1.0,
            state,
            markers: 2,
            latency_ms: 1.0,
        }
    }

    fn truth(frame: u64, x: f64, visible: u32) -> TruthRow {
        TruthRow {
            frame,
            t_s: 0.0,
            body: "alpha".into(),
            x,
            y: 0.0,
            z: 0.0,
            qw: 1.0,
            qx: 0.0,
            qy: 0.0,
            qz: 0.0,
            dist_m: x,
            az_deg: 0.0,
            el_deg: 0.0,
            n_markers_vis50: visible,
            n_markers_vis90: visible,
            best_side_px: 20.0,
            blur_px: 0.0,
            env: "test".into(),
            observer_yaw_deg: 0.0,
            ev: 0.0,
            iso: 0,
            exposure_s: 0.0,
            localisable: 1,
        }
    }

    #[test]
    fn only_measured_poses_of_eligible_bodies_count() {
        let poses = [
            pose(0, 1.001, TrackState::Confirmed),
            pose(1, 1.2, TrackState::Coasting),
            pose(2, 2.0, TrackState::Confirmed),
            pose(3, 1.0, TrackState::Measured),
        ];
        let truths = [truth(0, 1.0, 3), truth(1, 1.2, 2), truth(2, 1.4, 1), truth(4, 0.5, 2)];
        let evaluation = Evaluation::of(&poses, &truths);
        let near = evaluation.within_1_5_m().expect("there is such a bin");
        assert_eq!((near.eligible, near.measured), (3, 1));
        assert!((near.median_mm.expect("one") - 1.0).abs() < 1e-9);
        assert_eq!((evaluation.measured, evaluation.coasted), (3, 1));
        // Frame 2 is 60 cm off, frame 3 has nobody there.
        assert_eq!(evaluation.false_poses, 2);
        assert_eq!(evaluation.false_at[1], (3, "alpha".into(), None));
    }
}
