//! Test of a stage that sends tracks to ROS 2 or to the autopilot. The test has no receiver, so it
//! checks the stage's own counts.

use std::time::Duration;

use bytemuck::Zeroable;
use flockeye_config::Resolved;
use flockeye_contract::{FrameStamp, MeasuredBy, Pose, Track, TrackHeader, TrackState, Tracks};
use flockeye_runtime::clock;

use super::bench::Bench;
use super::report::{MUST_PASS, OWES};

/// Poses of the test.
const POSES: u64 = 40;
/// Time between two poses.
const PERIOD: Duration = Duration::from_millis(33);
/// Timeout for the counts in health.
const PATIENCE: Duration = Duration::from_secs(2);

/// Tests the candidate.
pub(super) fn run(bench: &mut Bench, _resolved: &Resolved) -> anyhow::Result<()> {
    let tracks = bench.ports.publisher::<Tracks>()?;
    for sequence in 0..POSES {
        let now_ns = clock::monotonic_ns();
        let stamp = FrameStamp {
            sequence,
            exposure_ns: now_ns - 20_000_000,
            published_ns: now_ns - 15_000_000,
            ..FrameStamp::default()
        };
        let good = track([1.0 + 0.01 * sequence as f64, -0.5, 0.25]);
        let header = TrackHeader { stamp, is_last: 1, ..TrackHeader::default() };
        tracks.send(header, &[good, track([f64::NAN; 3])])?;
        tracks.send(header, &[good])?;
        bench.pass(PERIOD)?;
    }
    let published = bench.wait(PATIENCE, |bench| {
        Ok(bench.published().filter(|published| *published >= POSES / 2))
    })?;
    let counted = bench.published().unwrap_or(0);
    bench.report.holds(
        "counts what it hands on, malformed messages between or not",
        MUST_PASS,
        published.is_some(),
        || format!("of {POSES} poses it counts {counted} as published"),
    );
    let runs = bench.runs();
    bench
        .report
        .holds("flies on with nobody at the other end", OWES, runs, || "it has ended".to_owned());
    Ok(())
}

fn track(position: [f64; 3]) -> Track {
    let pose = Pose { position, ..Pose::default() };
    let mut covariance = [0.0; 36];
    (0..6).for_each(|k| covariance[7 * k] = 1e-3);
    Track {
        name: "alpha".into(),
        observer_from_target: pose,
        predicted_observer_from_target: pose,
        measured_observer_from_target: pose,
        covariance,
        state: TrackState::Confirmed.code(),
        measured_by: MeasuredBy::Aligned.code(),
        ..Track::zeroed()
    }
}
