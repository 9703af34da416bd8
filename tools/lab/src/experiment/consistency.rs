//! Consistency of errors with their covariances over many independent flights.

use std::collections::BTreeMap;
use std::fmt;

use anyhow::ensure;
use clap::Args;
use flockeye_cli::Configuration;
use flockeye_contract::StageName;
use flockeye_geometry::filter::chi_square_quantile;
use flockeye_tables::{PoseRow, TruthRow};
use nalgebra::Vector3;
use serde::Serialize;

use super::laboratory::{FlightRecord, Laboratory};
use crate::evaluation::consistency::{Consistency, Nees, NeesVerdict, normalised};
use crate::evaluation::error::{ErrorSample, PoseOffset};
use crate::evaluation::{measurement_sample, track_sample};

/// Arguments of `experiment consistency`.
#[derive(Debug, Args)]
pub(crate) struct ConsistencyArguments {
    /// Which configuration. Its flow is lossless, its source simulated.
    #[command(flatten)]
    pub configuration: Configuration,
    /// How many flights, each with its own seed.
    #[arg(long, default_value_t = 50, value_parser = clap::value_parser!(u32).range(2..=10_000))]
    pub runs: u32,
    /// Frames of each flight.
    #[arg(long, default_value_t = 45, value_parser = clap::value_parser!(u64).range(2..=1_000_000))]
    pub frames: u64,
    /// One JSON object instead of a table.
    #[arg(long)]
    pub json: bool,
}

/// Half of the usual image size at half of the distances. Bodies have the same size in pixels, and
/// a frame takes a quarter of the time.
const DEFAULTS: [&str; 3] =
    ["camera.width=1920", "camera.height=960", "simulator.distance_m=[0.4, 1.0]"];

/// NEES of positions or rotations over all flights.
#[derive(Debug, Clone, PartialEq, Serialize)]
struct NeesOverRuns {
    /// Consistency over all frames of all flights.
    #[serde(flatten)]
    nees: Nees,
    /// Number of frame numbers at which at least half of the flights have a sample. Samples of one
    /// frame number are independent.
    moments: usize,
    /// Share of these frame numbers at which the mean over the flights is within its 95 % bounds.
    inside: Option<f64>,
}

/// The results.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct ConsistencyResult {
    runs: u32,
    frames: u64,
    seeds: [u32; 2],
    image_px: [u32; 2],
    distance_m: [f64; 2],
    /// Number of flights without a measurement.
    empty_runs: usize,
    /// Consistency of the frames' own measurements.
    measurements: Option<Consistency<NeesOverRuns>>,
    /// Consistency of tracks in measured frames.
    tracks: Option<Consistency<NeesOverRuns>>,
    /// Whether all means lie within their bounds.
    passes: bool,
}

/// Runs a flight for each seed, beginning with the configured one.
pub(super) fn run(arguments: &ConsistencyArguments) -> anyhow::Result<ConsistencyResult> {
    let mut laboratory =
        Laboratory::new(&arguments.configuration, &DEFAULTS, arguments.frames, arguments.json)?;
    let (first, _) = laboratory.plan(&[])?;
    ensure!(
        first.source.stage() == StageName::Simulator,
        "independent flights of '{}' cannot be had. Cure: simulate them (--source sim)",
        first.source.input
    );
    let seed = first.simulator.seed;
    let last = seed.checked_add(arguments.runs - 1);
    let seeds = [seed, last.unwrap_or(u32::MAX)];
    ensure!(last.is_some(), "simulator.seed {seed} leaves no room for {} more", arguments.runs);
    let mut flights = Vec::new();
    for (seed, number) in (seeds[0]..=seeds[1]).zip(1..) {
        let (_, plan) = laboratory.plan(&[format!("simulator.seed={seed}")])?;
        let what = format!("flight {number} of {}, seed {seed}", arguments.runs);
        flights.push(laboratory.fly(&what, &plan)?);
    }
    let measurements = Consistency::over_runs(&flights, measurement_sample);
    let tracks = Consistency::over_runs(&flights, track_sample);
    let all = [&measurements, &tracks];
    Ok(ConsistencyResult {
        runs: arguments.runs,
        frames: arguments.frames,
        seeds,
        image_px: [first.camera.width, first.camera.height],
        distance_m: first.simulator.distance_m,
        empty_runs: flights.iter().filter(|flight| !has_measurement(flight)).count(),
        passes: all.iter().all(|parts| parts.as_ref().is_some_and(Consistency::passes)),
        measurements,
        tracks,
    })
}

fn has_measurement(flight: &FlightRecord) -> bool {
    flight.poses.iter().any(PoseRow::is_measured)
}

impl Consistency<NeesOverRuns> {
    /// Summarizes flights. `None` without a sample.
    fn over_runs(
        flights: &[FlightRecord],
        sample: fn(&PoseRow, &TruthRow) -> Option<ErrorSample>,
    ) -> Option<Self> {
        let samples: Vec<Vec<(u64, ErrorSample)>> =
            flights.iter().flat_map(|flight| samples(flight, sample)).collect();
        let part = |error: fn(&PoseOffset) -> Vector3<f64>, first: usize| {
            let number = |(frame, (errors, covariance)): &(u64, ErrorSample)| {
                let block = covariance.fixed_view::<3, 3>(first, first).into_owned();
                Some((*frame, normalised(&error(errors), &block)?))
            };
            let numbers: Vec<Vec<(u64, f64)>> =
                samples.iter().map(|body| body.iter().filter_map(number).collect()).collect();
            NeesOverRuns::of(numbers, flights.len())
        };
        Some(Self {
            position: part(|error| error.position, 0)?,
            rotation: part(|error| error.rotation, 3)?,
        })
    }

    fn passes(&self) -> bool {
        let right = |part: &NeesOverRuns| part.nees.verdict == NeesVerdict::Consistent;
        right(&self.position) && right(&self.rotation)
    }
}

impl NeesOverRuns {
    /// Summarizes the normalised errors, with their frames, of each body in each flight.
    fn of(numbers: Vec<Vec<(u64, f64)>>, flights: usize) -> Option<Self> {
        let mut moments: BTreeMap<u64, Vec<f64>> = BTreeMap::new();
        for &(frame, number) in numbers.iter().flatten() {
            moments.entry(frame).or_default().push(number);
        }
        moments.retain(|_, numbers| 2 * numbers.len() >= flights);
        let inside = moments.values().filter(|numbers| {
            let degrees = 3.0 * numbers.len() as f64;
            let sum: f64 = numbers.iter().sum();
            let bound = |share| chi_square_quantile(degrees, share);
            (bound(0.025)..bound(0.975)).contains(&sum)
        });
        let share = inside.count() as f64 / moments.len() as f64;
        let runs: Vec<Vec<f64>> = numbers
            .into_iter()
            .map(|run| run.into_iter().map(|(_, number)| number).collect())
            .collect();
        Some(Self {
            nees: Nees::of_runs(&runs)?,
            moments: moments.len(),
            inside: (!moments.is_empty()).then_some(share),
        })
    }
}

/// Samples of the measured frames of each body.
fn samples(
    flight: &FlightRecord,
    sample: fn(&PoseRow, &TruthRow) -> Option<ErrorSample>,
) -> Vec<Vec<(u64, ErrorSample)>> {
    let truths: BTreeMap<(&str, u64), &TruthRow> =
        flight.truth.iter().map(|row| ((row.body.as_str(), row.frame), row)).collect();
    let mut bodies: BTreeMap<&str, Vec<(u64, ErrorSample)>> = BTreeMap::new();
    for pose in flight.poses.iter().filter(|pose| pose.is_measured()) {
        let truth = truths.get(&(pose.target.as_str(), pose.frame));
        if let Some(sample) = truth.and_then(|truth| sample(pose, truth)) {
            bodies.entry(&pose.target).or_default().push((pose.frame, sample));
        }
    }
    bodies.into_values().collect()
}

impl fmt::Display for ConsistencyResult {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [width, height] = self.image_px;
        let [near, far] = self.distance_m;
        writeln!(
            f,
            "{} flights (seeds {} to {}) of {} frames of {width}x{height}, neighbours at {near} to \
             {far} m; in {} nothing was measured",
            self.runs, self.seeds[0], self.seeds[1], self.frames, self.empty_runs
        )?;
        for (what, parts) in [("measurements", &self.measurements), ("tracks", &self.tracks)] {
            let Some(parts) = parts else {
                writeln!(f, "NEES of {what}: no sample")?;
                continue;
            };
            for (name, part) in [("position", &parts.position), ("rotation", &parts.rotation)] {
                writeln!(f, "NEES of {what}, {name}: {}", part.nees.text())?;
                if let Some(inside) = part.inside {
                    writeln!(
                        f,
                        "  the flights' mean lies within its bounds in {:.0} % of {} frames (95 % \
                         should)",
                        100.0 * inside,
                        part.moments
                    )?;
                }
            }
        }
        write!(
            f,
            "{}",
            if self.passes { "pass" } else { "no pass: not all means lie within their bounds" }
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::samples::{pose_at, truth_at};
    use flockeye_contract::TrackState;

    fn flight(offsets_m: &[f64]) -> FlightRecord {
        let at = |x: f64| Vector3::new(x, 0.0, 0.0);
        FlightRecord {
            poses: (0..)
                .zip(offsets_m)
                .map(|(frame, off)| pose_at(frame, at(1.0 + off), TrackState::Confirmed))
                .collect(),
            truth: (0..).zip(offsets_m).map(|(frame, _)| truth_at(frame, at(1.0))).collect(),
            ..FlightRecord::default()
        }
    }

    #[test]
    fn flights_are_independent_at_each_moment() {
        // A standard deviation of 1 cm: 4, 1 and 1, 4; one flight has no sample in the last frame.
        let flights = [flight(&[0.02, 0.01, 0.05]), flight(&[0.01, -0.02])];
        let parts = Consistency::over_runs(&flights, track_sample).expect("there are samples");
        let position = &parts.position;
        assert_eq!((position.nees.samples, position.moments), (5, 3));
        assert!((position.nees.mean - (4.0 + 1.0 + 25.0 + 1.0 + 4.0) / 5.0).abs() < 1e-6);
        // 5 of 6 degrees twice; 25 of 3 is too much.
        assert!((position.inside.expect("moments") - 2.0 / 3.0).abs() < 1e-12);
        // No rotation error at all: pessimistic.
        assert_eq!(parts.rotation.nees.verdict, NeesVerdict::Pessimistic);
        assert!(!parts.passes());
        assert!(Consistency::over_runs(&[FlightRecord::default()], track_sample).is_none());
    }

    #[test]
    fn moments_of_few_flights_are_left_out() {
        let flights = [flight(&[0.01]), flight(&[0.01]), flight(&[0.01, 0.01])];
        let parts =
            Consistency::over_runs(&flights, measurement_sample).expect("there are samples");
        assert_eq!((parts.position.nees.samples, parts.position.moments), (4, 1));
    }
}
