//! Test of a gateway: it receives tracks, and a peer on the network receives its reports.

use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use bytemuck::Zeroable;
use flockeye_config::Resolved;
use flockeye_contract::wire::Sighting;
use flockeye_contract::{FrameStamp, MeasuredBy, Pose, Track, TrackHeader, TrackState, Tracks};
use flockeye_network::{Listener, Network, NetworkParameters, ReportStream, utc_from_monotonic};
use flockeye_runtime::clock;
use flockeye_runtime::ports::Publisher;
use nalgebra::UnitQuaternion;

use super::bench::Bench;
use super::report::{ConformanceReport, MUST_PASS};

const PAGE: &str = "Gateway (track to the network)";

/// Poses of one test.
const POSES: u64 = 40;
/// Time between two poses.
const PERIOD: Duration = Duration::from_millis(33);
/// Timeout for a report.
const PATIENCE: Duration = Duration::from_secs(2);
/// Time in which no report must come.
const QUIET: Duration = Duration::from_millis(300);
/// Largest rounding error of numbers in a report.
const ROUNDED: f64 = 1e-5;

struct Script<'r> {
    resolved: &'r Resolved,
    tracks: Publisher<Tracks>,
    reports: Arc<ReportStream>,
    listener: Listener,
    sequence: u64,
}

/// Tests the candidate.
pub(crate) fn run(bench: &mut Bench, resolved: &Resolved) -> anyhow::Result<()> {
    let parameters = NetworkParameters::of_onlooker(&resolved.pipeline);
    let listener = Network::open(&parameters).context("the test's own session")?.listener()?;
    let link = Duration::from_secs_f64(resolved.pipeline.supervision.start_s);
    let observer = &resolved.pipeline.observer.name;
    let is_alive = bench.wait(link, |_| {
        let peers = listener.snapshot();
        // The peer is connected, so it receives all further reports.
        Ok(peers
            .observers
            .get(observer)
            .is_some_and(|peer| peer.alive && peer.is_heard)
            .then_some(()))
    })?;
    bench.report.holds("says that it is alive", PAGE, is_alive.is_some(), || {
        format!(
            "no liveliness token of '{observer}' at {} in {} s",
            parameters.connect.join(", "),
            link.as_secs()
        )
    });
    if is_alive.is_none() {
        return Ok(());
    }
    let mut script = Script {
        resolved,
        tracks: bench.ports.publisher()?,
        reports: listener.stream(256),
        listener,
        sequence: 0,
    };
    script.poses(bench)?;
    script.kept_back(bench)?;
    let refused: u64 = script.refused();
    bench
        .report
        .holds("reports can be read", PAGE, refused == 0, || format!("{refused} were refused"));
    Ok(())
}

impl Script<'_> {
    fn stamp(&mut self) -> FrameStamp {
        self.sequence += 1;
        let now_ns = clock::monotonic_ns();
        FrameStamp {
            sequence: self.sequence,
            exposure_ns: now_ns - 20_000_000,
            stream_ns: now_ns,
            published_ns: now_ns - 15_000_000,
            ..FrameStamp::default()
        }
    }

    /// A track for a stamp, whose covariance has only different numbers.
    fn track(&self, stamp: &FrameStamp) -> Track {
        let number = stamp.sequence as f64;
        let turn = UnitQuaternion::from_euler_angles(0.1 * number, 0.2, 0.3);
        let name = self.resolved.bodies.iter().next().map_or("alpha", |body| body.name.as_str());
        let position = [1.0 + 0.01 * number, -0.5, 0.25];
        let pose = Pose { position, orientation: turn.coords.into() };
        let mut covariance = [0.0; 36];
        for row in 0..6 {
            for column in 0..6 {
                let (low, high) = (row.min(column), row.max(column));
                covariance[6 * row + column] =
                    if low == high { 1e-3 } else { 1e-5 * (6 * low + high) as f64 };
            }
        }
        Track {
            name: name.into(),
            observer_from_target: pose,
            // Different poses, so that a mix-up is visible.
            predicted_observer_from_target: Pose { position: [9.0, 9.0, 9.0], ..pose },
            measured_observer_from_target: Pose { position: [-9.0, 9.0, 9.0], ..pose },
            angular_velocity: [0.4, -0.5, 0.6],
            unseen_ns: 250_000_000,
            predicted_ns: stamp.exposure_ns + 20_000_000,
            covariance,
            state: TrackState::Confirmed.code(),
            measured_by: MeasuredBy::Aligned.code(),
            markers: 2,
            linear_velocity: [0.1, 0.2, 0.3],
            ..Track::zeroed()
        }
    }

    fn send(&self, stamp: FrameStamp, track: Track) -> anyhow::Result<()> {
        Ok(self
            .tracks
            .send(TrackHeader { stamp, is_last: 1, ..TrackHeader::default() }, &[track])?)
    }

    /// The report on this frame. Earlier reports are skipped, because a new subscriber also
    /// receives the last values.
    fn report_of(
        &self,
        bench: &mut Bench,
        stamp: &FrameStamp,
        patience: Duration,
    ) -> anyhow::Result<Option<(Sighting, i64)>> {
        let observer = &self.resolved.pipeline.observer.name;
        bench.wait(patience, |_| {
            let heard = self.reports.recv_timeout(Duration::from_millis(1));
            let is_meant =
                |report: &Sighting| report.observer == *observer && report.frame == stamp.sequence;
            let meant = heard.filter(|heard| is_meant(&heard.report));
            Ok(meant.map(|heard| (heard.report, heard.arrived_monotonic_ns)))
        })
    }

    fn poses(&mut self, bench: &mut Bench) -> anyhow::Result<()> {
        let (mut delays_ms, begun) = (Vec::new(), Instant::now());
        for number in 0..POSES {
            let stamp = self.stamp();
            let track = self.track(&stamp);
            let sent_ns = clock::monotonic_ns();
            self.send(stamp, track)?;
            let heard = self.report_of(bench, &stamp, PATIENCE)?;
            bench.report.holds("each pose is reported", PAGE, heard.is_some(), || {
                format!("the pose of frame {} was not in {} s", stamp.sequence, PATIENCE.as_secs())
            });
            let Some((heard, arrived_ns)) = heard else { break };
            delays_ms.push((arrived_ns - sent_ns) as f64 * 1e-6);
            self.compare(&mut bench.report, &stamp, &track, &heard);
            bench.pass(
                (begun + PERIOD * (number as u32 + 1)).saturating_duration_since(Instant::now()),
            )?;
        }
        let slowest = delays_ms.iter().copied().fold(f64::NAN, f64::max);
        bench.report.median("from the track to a peer, median", delays_ms, "ms");
        bench.report.figure("the slowest", slowest, "ms");
        Ok(())
    }

    /// Checks that a report has the values of its track.
    fn compare(
        &self,
        report: &mut ConformanceReport,
        stamp: &FrameStamp,
        track: &Track,
        heard: &Sighting,
    ) {
        let what = "reports say what the track says";
        let observer = self.resolved.pipeline.observer.name.as_str();
        report.field(what, PAGE, "observer", heard.observer.as_str(), observer);
        report.field(what, PAGE, "target", heard.target.name.clone(), track.name.to_string());
        report.field(what, PAGE, "frame", heard.frame, stamp.sequence);
        report.field(what, PAGE, "state", heard.target.state, TrackState::Confirmed);
        report.field(what, PAGE, "markers", heard.target.markers, track.markers);
        report.field(what, PAGE, "measured_by", heard.target.measured_by, MeasuredBy::Aligned);
        report.field(what, PAGE, "epoch", heard.epoch, stamp.epoch);
        let upper = (0..6).flat_map(|row| (row..6).map(move |column| 6 * row + column));
        let covariance: Vec<f64> = upper.map(|index| track.covariance[index]).collect();
        let pose = track.observer_from_target;
        let said = &heard.target;
        // A quaternion and its negative are the same rotation.
        let sign = if said.orientation[3] * pose.orientation[3] < 0.0 { -1.0 } else { 1.0 };
        let orientation = said.orientation.map(|q| sign * q);
        for (field, found, wanted) in [
            ("position", &said.position[..], &pose.position[..]),
            ("orientation", &orientation, &pose.orientation),
            ("covariance", &said.covariance, &covariance),
            ("linear_velocity", &said.linear_velocity, &track.linear_velocity),
            ("angular_velocity", &said.angular_velocity, &track.angular_velocity),
            ("unseen_s", &[said.unseen_s], &[0.25]),
        ] {
            let is_same = found.len() == wanted.len()
                && found.iter().zip(wanted).all(|(found, wanted)| (found - wanted).abs() < ROUNDED);
            report.holds(what, PAGE, is_same, || {
                format!("{field} is {found:?}, and must be {wanted:?}")
            });
        }
        let (stamp_ns, _) = utc_from_monotonic(stamp.exposure_ns);
        let off_ms = (heard.stamp_utc_ns - stamp_ns) as f64 * 1e-6;
        let is_right = (20.0..1000.0).contains(&heard.latency_ms) && off_ms.abs() < 5.0;
        report.holds("reports say how old they are", PAGE, is_right, || {
            format!(
                "latency_ms is {}, of a frame that was exposed at least 20 ms before; stamp_utc_ns is {off_ms:.1} \
                 ms from the exposure",
                heard.latency_ms
            )
        });
    }

    /// Tracks that must not be reported.
    fn kept_back(&mut self, bench: &mut Bench) -> anyhow::Result<()> {
        let stamp = self.stamp();
        let good = self.track(&stamp);
        let nowhere = Pose { position: [f64::NAN; 3], ..good.observer_from_target };
        let old = FrameStamp { sequence: 1, ..stamp };
        for (what, page, stamp, bad) in [
            (
                "tentative tracks are kept back",
                PAGE,
                stamp,
                Track { state: TrackState::Tentative.code(), ..good },
            ),
            ("older frames are kept back", PAGE, old, good),
            (
                "malformed tracks are refused",
                MUST_PASS,
                stamp,
                Track { observer_from_target: nowhere, ..good },
            ),
        ] {
            self.send(stamp, bad)?;
            let heard = self.report_of(bench, &stamp, QUIET)?;
            bench.report.holds(what, page, heard.is_none(), || {
                format!("frame {} was reported", stamp.sequence)
            });
        }
        let stamp = self.stamp();
        self.send(stamp, self.track(&stamp))?;
        let heard = self.report_of(bench, &stamp, PATIENCE)?;
        bench.report.holds(
            "what is kept back costs nothing else",
            MUST_PASS,
            heard.is_some(),
            || "the good pose after it was not reported".to_owned(),
        );
        Ok(())
    }

    fn refused(&self) -> u64 {
        let peers = self.listener.snapshot();
        peers.refused + peers.observers.values().map(|peer| peer.refused.total()).sum::<u64>()
    }
}
