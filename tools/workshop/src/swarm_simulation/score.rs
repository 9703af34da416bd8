//! Comparison of the drones' claims about each other with the truth.
//!
//! A claim is a drone's estimate of another drone's pose at an instant. The truth is known at the
//! exposures of a drone's camera. Between two exposures it is interpolated linearly, and rotations
//! at a constant rate.

use std::collections::{BTreeMap, VecDeque};
use std::fmt;

use flockeye_cli::text_table::TextTable;
use flockeye_contract::SwarmWay;
use flockeye_geometry::filter::chi_square_quantile;
use flockeye_geometry::statistics::{mean, median, quantile};
use flockeye_peer::UncertainPose;
use nalgebra::Isometry3;
use serde::Serialize;

/// Number of truths of a pair that are kept, for a few seconds.
const KEPT_TRUTHS: usize = 256;
/// Largest number of claims that wait for a later truth.
const WAITING_CLAIMS: usize = 4096;
/// Largest gap between exposures that is interpolated.
const LONGEST_GAP_NS: i64 = 500_000_000;

/// A drone's estimate of another drone's pose.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Claim {
    /// The drone that makes the claim.
    pub from: String,
    /// The other drone.
    pub to: String,
    /// The instant of the pose, CLOCK_MONOTONIC, nanoseconds.
    pub at_ns: i64,
    /// The way in which the pose is known.
    pub way: SwarmWay,
    /// The pose of `to` in the frame of `from`.
    pub pose: UncertainPose,
    /// The pose from the sightings of `from` alone, if there are any.
    pub alone: Option<UncertainPose>,
}

/// The error of a claim.
#[derive(Debug, Clone, Copy, PartialEq)]
struct ClaimError {
    position_m: f64,
    rotation_rad: f64,
    /// Normalised squared error of the pose; 6 on average for a correct covariance.
    normalized: f64,
}

type Pair = (String, String);

/// Collects claims and truths.
#[derive(Debug, Default)]
pub(crate) struct ClaimScore {
    truths: BTreeMap<Pair, VecDeque<(i64, Isometry3<f64>)>>,
    waiting: VecDeque<Claim>,
    errors: BTreeMap<SwarmWay, Vec<ClaimError>>,
    /// Errors of poses that are known in both ways: mutual, then alone.
    both: [Vec<ClaimError>; 2],
    /// Exposures of each drone's newest frames.
    exposures: BTreeMap<String, BTreeMap<u64, i64>>,
    /// Errors of other drones' estimates of these exposures: milliseconds, and in stated
    /// deviations.
    clock_errors: Vec<[f64; 2]>,
    /// For each drone's newest frames: time of the first pose from fusion, and times of arrival at
    /// other drones.
    reports: BTreeMap<(String, u64), (Option<i64>, Vec<i64>)>,
    /// Latencies of reports between the drones' programs, milliseconds.
    took_ms: Vec<f64>,
}

impl ClaimScore {
    /// Takes the true pose of `to` in the frame of `from` at an exposure, CLOCK_MONOTONIC,
    /// nanoseconds.
    pub(crate) fn truth(&mut self, from: &str, to: &str, at_ns: i64, from_from_to: Isometry3<f64>) {
        let truths = self.truths.entry((from.to_owned(), to.to_owned())).or_default();
        truths.push_back((at_ns, from_from_to));
        if truths.len() > KEPT_TRUTHS {
            truths.pop_front();
        }
    }

    /// Takes the exposure of a drone's frame, CLOCK_MONOTONIC, nanoseconds.
    pub(crate) fn exposed(&mut self, drone: &str, frame: u64, at_ns: i64) {
        let exposures = self.exposures.entry(drone.to_owned()).or_default();
        exposures.insert(frame, at_ns);
        if exposures.len() > KEPT_TRUTHS {
            exposures.pop_first();
        }
    }

    /// Takes another drone's estimate of a frame's exposure, with its deviation.
    pub(crate) fn timed(&mut self, drone: &str, frame: u64, at_ns: i64, deviation_ns: i64) {
        let exposures = self.exposures.get(drone);
        if let Some(true_ns) = exposures.and_then(|exposures| exposures.get(&frame)) {
            let error_ns = (at_ns - true_ns).abs() as f64;
            self.clock_errors.push([error_ns * 1e-6, error_ns / deviation_ns.max(1) as f64]);
        }
    }

    /// Takes the time when a drone's fusion sent a pose of a frame, CLOCK_MONOTONIC, nanoseconds.
    pub(crate) fn sent(&mut self, drone: &str, frame: u64, sent_ns: i64) {
        self.report_of(drone, frame).0.get_or_insert(sent_ns);
        self.settle_report(drone, frame);
    }

    /// Takes the time when that pose arrived at another drone, CLOCK_MONOTONIC, nanoseconds.
    pub(crate) fn arrived(&mut self, drone: &str, frame: u64, arrived_ns: i64) {
        self.report_of(drone, frame).1.push(arrived_ns);
        self.settle_report(drone, frame);
    }

    /// Takes a claim. It is compared when a later truth is known.
    pub(crate) fn claim(&mut self, claim: Claim) {
        self.waiting.push_back(claim);
        if self.waiting.len() > WAITING_CLAIMS {
            self.waiting.pop_front();
        }
    }

    /// Compares the claims whose truth is known.
    pub(crate) fn settle(&mut self) {
        for claim in std::mem::take(&mut self.waiting) {
            let pair = (claim.from.clone(), claim.to.clone());
            let truths = self.truths.get(&pair);
            let newest = truths.and_then(|truths| truths.back()).map(|(at_ns, _)| *at_ns);
            if newest.is_none_or(|newest| newest < claim.at_ns) {
                self.waiting.push_back(claim);
                continue;
            }
            let Some(truth) = truths.and_then(|truths| truth_at(truths, claim.at_ns)) else {
                continue;
            };
            let error = ClaimError::of(&claim.pose, &truth);
            self.errors.entry(claim.way).or_default().push(error);
            if let (SwarmWay::Mutual, Some(alone)) = (claim.way, &claim.alone) {
                self.both[0].push(error);
                self.both[1].push(ClaimError::of(alone, &truth));
            }
        }
    }

    /// The report of all comparisons.
    pub(crate) fn report(&self) -> SwarmReport {
        let ways = self.errors.iter();
        let [mutual, alone] = self.both.each_ref().map(|errors| PoseFigures::of(errors));
        SwarmReport {
            ways: ways
                .filter_map(|(way, errors)| Some((way.name().to_owned(), PoseFigures::of(errors)?)))
                .collect(),
            mutual: mutual.zip(alone).map(|(mutual, alone)| Gain { mutual, alone }),
            clocks: self.clock_figures(),
            reports_ms: median_and_most(self.took_ms.iter().copied()),
        }
    }

    fn report_of(&mut self, drone: &str, frame: u64) -> &mut (Option<i64>, Vec<i64>) {
        if self.reports.len() > WAITING_CLAIMS {
            self.reports.clear();
        }
        self.reports.entry((drone.to_owned(), frame)).or_default()
    }

    fn settle_report(&mut self, drone: &str, frame: u64) {
        let (sent, arrivals) = self.report_of(drone, frame);
        if let Some(sent_ns) = *sent {
            let took: Vec<f64> =
                arrivals.drain(..).map(|arrived_ns| (arrived_ns - sent_ns) as f64 * 1e-6).collect();
            self.took_ms.extend(took);
        }
    }

    fn clock_figures(&self) -> Option<ClockFigures> {
        let of = |k: usize| median_and_most(self.clock_errors.iter().map(move |error| error[k]));
        Some(ClockFigures { error_ms: of(0)?, deviations: of(1)? })
    }
}

/// Median and 95 % quantile of values; `None` without values.
fn median_and_most(values: impl Iterator<Item = f64>) -> Option<[f64; 2]> {
    let mut rising: Vec<f64> = values.collect();
    rising.sort_by(f64::total_cmp);
    Some([median(&rising)?, quantile(&rising, 0.95)?])
}

/// The truth at an instant, interpolated between the neighbouring ones.
fn truth_at(truths: &VecDeque<(i64, Isometry3<f64>)>, at_ns: i64) -> Option<Isometry3<f64>> {
    let after = truths.partition_point(|(ns, _)| *ns < at_ns);
    let (after_ns, later) = truths.get(after)?;
    if *after_ns == at_ns {
        return Some(*later);
    }
    let (before_ns, earlier) = truths.get(after.checked_sub(1)?)?;
    let gap_ns = after_ns - before_ns;
    let share = (at_ns - before_ns) as f64 / gap_ns as f64;
    // Opposite rotations cannot be interpolated, but no drone turns so fast.
    (gap_ns <= LONGEST_GAP_NS).then(|| earlier.try_lerp_slerp(later, share, 1e-9)).flatten()
}

impl ClaimError {
    fn of(claimed: &UncertainPose, truth: &Isometry3<f64>) -> Self {
        let error = claimed.difference(truth);
        let factor = claimed.covariance.cholesky();
        Self {
            position_m: error.fixed_rows::<3>(0).norm(),
            rotation_rad: error.fixed_rows::<3>(3).norm(),
            normalized: factor.map_or(f64::INFINITY, |factor| error.dot(&factor.solve(&error))),
        }
    }
}

/// Error statistics of many poses.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct PoseFigures {
    /// Number of poses.
    pub poses: usize,
    /// Median and 95 % of the distance from the true position, millimetres.
    pub position_mm: [f64; 2],
    /// Median and 95 % of the angle to the true rotation, degrees.
    pub rotation_deg: [f64; 2],
    /// Mean of the normalised squared errors; 6 for correct covariances.
    pub normalized: f64,
    /// Share of poses within the 95 % bound of their covariance.
    pub share_within_95: f64,
}

impl PoseFigures {
    fn of(errors: &[ClaimError]) -> Option<Self> {
        let normalized: Vec<f64> = errors.iter().map(|error| error.normalized).collect();
        let most = chi_square_quantile(6.0, 0.95);
        let within = normalized.iter().filter(|value| **value <= most).count();
        Some(Self {
            poses: errors.len(),
            position_mm: median_and_most(errors.iter().map(|error| error.position_m * 1e3))?,
            rotation_deg: median_and_most(errors.iter().map(|e| e.rotation_rad.to_degrees()))?,
            normalized: mean(&normalized)?,
            share_within_95: within as f64 / errors.len() as f64,
        })
    }
}

/// Errors of pairs that see each other, with and without the other drone's sightings, at the same
/// instants.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct Gain {
    /// Errors with both drones' sightings.
    pub mutual: PoseFigures,
    /// Errors with the observer's own sightings alone.
    pub alone: PoseFigures,
}

/// Errors of the drones' estimates of others' exposures.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct ClockFigures {
    /// Median and 95 % of the error, milliseconds.
    pub error_ms: [f64; 2],
    /// Median and 95 % of the error in stated deviations.
    pub deviations: [f64; 2],
}

/// The report of all comparisons.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct SwarmReport {
    /// Errors by the way in which the poses are known.
    pub ways: BTreeMap<String, PoseFigures>,
    /// The gain from sightings of both sides.
    pub mutual: Option<Gain>,
    /// Errors of the estimated exposures.
    pub clocks: Option<ClockFigures>,
    /// Median and 95 % of the time from a drone's topic `track` until another drone's gateway has
    /// the pose, milliseconds.
    pub reports_ms: Option<[f64; 2]>,
}

impl fmt::Display for SwarmReport {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let titles = ["known", "poses", "mm", "95 %", "degrees", "95 %", "NEES", "within 95 %"];
        let mut table = TextTable::new(1, &titles);
        let mut row = |name: &str, figures: &PoseFigures| {
            let [position, most] = figures.position_mm;
            let [rotation, most_rotated] = figures.rotation_deg;
            table.row([
                name.to_owned(),
                figures.poses.to_string(),
                format!("{position:.1}"),
                format!("{most:.1}"),
                format!("{rotation:.2}"),
                format!("{most_rotated:.2}"),
                format!("{:.1}", figures.normalized),
                format!("{:.0} %", 100.0 * figures.share_within_95),
            ]);
        };
        self.ways.iter().for_each(|(name, figures)| row(name, figures));
        if let Some(Gain { alone, .. }) = &self.mutual {
            row("alone", alone);
        }
        formatter.write_str(&table.text())?;
        if let Some(ClockFigures { error_ms: [error, most], deviations: [deviation, worst] }) =
            &self.clocks
        {
            write!(
                formatter,
                "\nothers' exposures: {error:.2} ms off ({most:.2} in 95 %), {deviation:.1} of the deviations \
                 given ({worst:.1} in 95 %)"
            )?;
        }
        if let Some([took, most]) = self.reports_ms {
            write!(
                formatter,
                "\nfrom a drone's track to another drone: {took:.2} ms ({most:.2} in 95 %)"
            )?;
        }
        let Some(Gain { mutual, alone }) = &self.mutual else { return Ok(()) };
        let ratio = |mutual: [f64; 2], alone: [f64; 2]| {
            format!("{:.2} ({:.2} in 95 %)", mutual[0] / alone[0], mutual[1] / alone[1])
        };
        write!(
            formatter,
            "\nmutual beside alone, of {} poses at the same instants: position {}, rotation {}",
            alone.poses,
            ratio(mutual.position_mm, alone.position_mm),
            ratio(mutual.rotation_deg, alone.rotation_deg)
        )
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use nalgebra::{Matrix6, UnitQuaternion, Vector3};

    use super::*;

    const MS: i64 = 1_000_000;

    fn at(x: f64, yaw: f64) -> Isometry3<f64> {
        let yaw = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw);
        Isometry3::from_parts(Vector3::new(x, 0.0, 0.0).into(), yaw)
    }

    fn pose(x: f64) -> UncertainPose {
        UncertainPose { a_from_b: at(x, 0.0), covariance: Matrix6::identity() * 1e-6 }
    }

    fn claim(at_ns: i64, way: SwarmWay, x: f64) -> Claim {
        Claim { from: "a".into(), to: "b".into(), at_ns, way, pose: pose(x), alone: None }
    }

    #[test]
    fn a_claim_is_compared_with_the_truth_of_its_instant() {
        let mut score = ClaimScore::default();
        score.truth("a", "b", 0, at(1.0, -0.1));
        // Half way between: at 1.5 m, turned by nothing.
        let alone = Some(pose(1.498));
        score.claim(Claim { alone, ..claim(50 * MS, SwarmWay::Mutual, 1.501) });
        score.settle();
        assert_eq!(score.report().ways.len(), 0, "what is true then is not known yet");
        score.truth("a", "b", 100 * MS, at(2.0, 0.1));
        score.settle();
        let report = score.report();
        let Gain { mutual, alone } = report.mutual.as_ref().unwrap();
        assert_eq!(report.ways["mutual"], *mutual);
        assert!((mutual.position_mm[0] - 1.0).abs() < 1e-9 && mutual.rotation_deg[0] < 1e-9);
        assert!((alone.position_mm[0] - 2.0).abs() < 1e-9);
        assert!((mutual.normalized - 1.0).abs() < 1e-6 && (alone.normalized - 4.0).abs() < 1e-6);
        assert_eq!((mutual.share_within_95, alone.share_within_95), (1.0, 1.0));
        assert_eq!(report.clocks, None);
        assert!(report.to_string().contains("position 0.50 (0.50 in 95 %)"), "{report}");
    }

    #[test]
    fn what_the_truth_says_nothing_of_does_not_count() {
        let mut score = ClaimScore::default();
        score.truth("a", "b", 0, at(1.0, 0.0));
        score.truth("a", "b", 900 * MS, at(1.0, 0.0));
        for at_ns in [-5 * MS, 400 * MS] {
            score.claim(claim(at_ns, SwarmWay::Direct, 1.0));
        }
        score.claim(Claim { to: "nobody".into(), ..claim(0, SwarmWay::Direct, 1.0) });
        score.settle();
        let nothing =
            SwarmReport { ways: BTreeMap::new(), mutual: None, clocks: None, reports_ms: None };
        assert_eq!(score.report(), nothing);
    }

    #[test]
    fn what_others_take_for_an_exposure_is_compared_with_it() {
        let mut score = ClaimScore::default();
        score.exposed("a", 7, 100 * MS);
        score.timed("a", 7, 102 * MS, MS);
        score.timed("a", 8, 102 * MS, MS);
        score.timed("b", 7, 102 * MS, MS);
        let clocks = score.report().clocks.unwrap();
        assert_eq!(clocks, ClockFigures { error_ms: [2.0; 2], deviations: [2.0; 2] });
    }

    #[test]
    fn a_report_is_under_way_from_the_first_word_of_its_frame_whoever_is_heard_first() {
        let mut score = ClaimScore::default();
        score.arrived("a", 7, 103 * MS);
        score.sent("a", 7, 102 * MS);
        score.sent("a", 7, 109 * MS);
        score.arrived("a", 7, 105 * MS);
        score.arrived("a", 8, 105 * MS);
        assert_eq!(score.report().reports_ms, Some([2.0, 3.0]));
    }
}
