//! Test of a fusion stage: detection records of a body with a known pose.

use std::time::Duration;

use flockeye_config::Resolved;
use flockeye_contract::{
    DetectedMarker, DetectionHeader, Detections, FrameEnd, FrameEnds, FrameStamp, NONE, PlanHeader,
    Plans, StopReason, Track, TrackHeader, TrackState, Tracks, ViewHeader, ViewKind, Views,
};
use flockeye_geometry::body::Body;
use flockeye_geometry::view::View;
use flockeye_runtime::clock;
use flockeye_runtime::ports::{Publisher, Subscriber};
use nalgebra::{Isometry3, Matrix6, Point3, Translation3, Unit, UnitQuaternion, Vector3};

use super::bench::Bench;
use super::report::OWES;

const PAGE: &str = "Fusion (view, detection, frame_end, rotation to track, plan)";
const TRACK_PAGE: &str = "Layout";

/// Frames in which the body is seen.
const FRAMES: u64 = 45;
const INTERVAL: Duration = Duration::from_millis(33);
/// Time for a frame from its end to its last tracks.
const PATIENCE: Duration = Duration::from_secs(1);
/// Number of frames without last tracks or a plan after which the test waits no more.
const MOST_UNANSWERED: u32 = 3;
/// Pixels along a side of a view.
const VIEW_PX: u32 = 16;
/// Field of a view along each side, radians.
const FIELD_RAD: f64 = 2.0;
/// Stated deviation of rays, radians.
const DEVIATION_RAD: f64 = 3e-4;

/// The messages of fusion about a frame.
#[derive(Default)]
struct FrameAnswer {
    tracks: Vec<Track>,
    lasts: u32,
    plan: Option<PlanHeader>,
}

struct Script<'r> {
    resolved: &'r Resolved,
    views: Publisher<Views>,
    records: Publisher<Detections>,
    ends: Publisher<FrameEnds>,
    tracks: Subscriber<Tracks>,
    plans: Subscriber<Plans>,
    plan_id: u64,
    sequence: u64,
    unanswered: u32,
}

/// Tests the candidate.
pub(crate) fn run(bench: &mut Bench, resolved: &Resolved) -> anyhow::Result<()> {
    let mut script = Script {
        resolved,
        views: bench.ports.publisher_of_lane(0)?,
        records: bench.ports.publisher()?,
        ends: bench.ports.publisher()?,
        tracks: bench.ports.subscriber()?,
        plans: bench.ports.subscriber()?,
        plan_id: 0,
        sequence: 0,
        unanswered: 0,
    };
    if script.first_plan(bench)? {
        script.body_in_sight(bench)?;
        script.body_out_of_sight(bench)?;
        script.malformed(bench)?;
    }
    bench.pass(Duration::from_millis(800))?;
    Ok(())
}

impl Script<'_> {
    fn first_plan(&mut self, bench: &mut Bench) -> anyhow::Result<bool> {
        let plans = &mut self.plans;
        let plan = bench.wait(PATIENCE, |_| Ok(plans.receive_with_verdict()?))?;
        bench.report.holds("a first plan opens the flow", PAGE, plan.is_some(), || {
            "no plan came before the first frame".to_owned()
        });
        let Some((plan, verdict)) = plan else { return Ok(false) };
        bench.report.verdict("plans pass the contract's check", verdict);
        bench.report.field(
            "a first plan opens the flow",
            PAGE,
            "has_after",
            plan.header.has_after,
            0,
        );
        self.plan_id = plan.header.plan_id;
        Ok(true)
    }

    fn stamp(&mut self) -> FrameStamp {
        self.sequence += 1;
        let now_ns = clock::monotonic_ns();
        FrameStamp {
            sequence: self.sequence,
            exposure_ns: now_ns - 10_000_000,
            stream_ns: now_ns - 10_000_000,
            published_ns: now_ns - 5_000_000,
            ..FrameStamp::default()
        }
    }

    /// Sends a frame with one view that has these markers. Returns the messages of fusion about it.
    fn fly(
        &mut self,
        bench: &mut Bench,
        stamp: FrameStamp,
        markers: &[DetectedMarker],
    ) -> anyhow::Result<FrameAnswer> {
        let now_ns = clock::monotonic_ns();
        let shown = view();
        let view = ViewHeader {
            stamp,
            plan_id: self.plan_id,
            taken_ns: stamp.published_ns,
            issued_ns: stamp.published_ns,
            camera_from_view: shown.camera_from_view.coords.into(),
            focal_px: shown.focal_px,
            size_px: VIEW_PX,
            stride: VIEW_PX,
            kind: ViewKind::Partition.code(),
            target: NONE,
            ..ViewHeader::default()
        };
        // The view is too small to show a body. Only its detection record matters.
        self.views.send(view, &[128; (VIEW_PX * VIEW_PX) as usize])?;
        let record = DetectionHeader {
            stamp,
            plan_id: self.plan_id,
            taken_ns: stamp.published_ns,
            issued_ns: stamp.published_ns,
            received_ns: now_ns,
            sent_ns: now_ns,
            hits: markers.len() as u32,
            ..DetectionHeader::default()
        };
        self.records.send(record, markers)?;
        let end = FrameEnd {
            stamp,
            plan_id: self.plan_id,
            taken_ns: stamp.published_ns,
            ended_ns: now_ns,
            views_issued: 1,
            reason: StopReason::Complete.code(),
            ..FrameEnd::default()
        };
        self.ends.send(end, &[])?;
        let mut told = FrameAnswer::default();
        let (tracks, plans) = (&mut self.tracks, &mut self.plans);
        let mut plan_id = self.plan_id;
        let patience = if self.unanswered < MOST_UNANSWERED { PATIENCE } else { INTERVAL };
        let answered = bench.wait(patience, |bench| {
            while let Some((message, verdict)) = tracks.receive_with_verdict()? {
                bench.report.verdict("tracks pass the contract's check", verdict);
                let TrackHeader { stamp: of, generation, is_last } = message.header;
                if of.is_same_frame(&stamp) {
                    bench.report.field(
                        "tracks say whose they are",
                        PAGE,
                        "generation",
                        generation,
                        0,
                    );
                    told.lasts += is_last;
                    told.tracks.extend_from_slice(message.items());
                }
            }
            while let Some((message, verdict)) = plans.receive_with_verdict()? {
                bench.report.verdict("plans pass the contract's check", verdict);
                let plan = message.header;
                bench.report.holds("plan_id rises", PAGE, plan.plan_id > plan_id, || {
                    format!("plan_id is {} after {plan_id}", plan.plan_id)
                });
                plan_id = plan.plan_id;
                if plan.has_after != 0 && plan.after.is_same_frame(&stamp) {
                    told.plan = Some(plan);
                }
            }
            Ok((told.lasts > 0 && told.plan.is_some()).then_some(()))
        })?;
        self.unanswered += u32::from(answered.is_none());
        self.plan_id = plan_id;
        bench.report.holds(
            "one track message with is_last for each frame",
            PAGE,
            told.lasts == 1,
            || {
                format!(
                    "frame {} had {} in {} ms",
                    stamp.sequence,
                    told.lasts,
                    patience.as_millis()
                )
            },
        );
        bench.report.holds("a plan follows each frame", PAGE, told.plan.is_some(), || {
            format!("no plan came whose after is frame {}", stamp.sequence)
        });
        Ok(told)
    }

    /// Test with a body that flies by.
    fn body_in_sight(&mut self, bench: &mut Bench) -> anyhow::Result<()> {
        let Some(body) = self.resolved.bodies.iter().next() else { return Ok(()) };
        let (mut errors_mm, mut took_ms, mut measured, mut age_ns) =
            (Vec::new(), Vec::new(), 0, -1);
        let mut state = None;
        for number in 0..FRAMES {
            let stamp = self.stamp();
            let pose = pose(number as f64 * INTERVAL.as_secs_f64());
            let begun_ns = clock::monotonic_ns();
            let told = self.fly(bench, stamp, &markers(body, &pose, number))?;
            if told.lasts == 0 {
                return Ok(());
            }
            took_ms.push((clock::monotonic_ns() - begun_ns) as f64 * 1e-6);
            let truth =
                self.resolved.observer_from_camera * pose * body.target_from_markers.inverse();
            for track in told.tracks.iter().filter(|track| track.name.to_string() == body.name) {
                bench.report.field(
                    "tracks name their target",
                    TRACK_PAGE,
                    "target",
                    track.target,
                    0,
                );
                let covariance = Matrix6::from_row_slice(&track.covariance);
                bench.report.holds(
                    "covariances are positive",
                    TRACK_PAGE,
                    covariance.cholesky().is_some(),
                    || format!("covariance of {} is {:?}", body.name, covariance.diagonal()),
                );
                bench.report.holds(
                    "a track grows older",
                    TRACK_PAGE,
                    track.age_ns >= age_ns,
                    || format!("age_ns is {} after {age_ns}", track.age_ns),
                );
                (age_ns, state) = (track.age_ns, Some(track.state));
                if track.is_measured() {
                    measured += 1;
                    let found = Vector3::from(track.measured_observer_from_target.position);
                    errors_mm.push((found - truth.translation.vector).norm() * 1e3);
                }
            }
            bench.pass(INTERVAL)?;
        }
        bench.report.holds("a body in sight is measured", PAGE, measured > 0, || {
            format!("{} was measured in none of {FRAMES} frames that show its markers", body.name)
        });
        let believed = [TrackState::Confirmed, TrackState::Measured].map(TrackState::code);
        bench.report.holds(
            "a track is believed in time",
            TRACK_PAGE,
            state.is_some_and(|state| believed.contains(&state)),
            || format!("after {FRAMES} frames in sight the state is {state:?}"),
        );
        bench.report.figure(
            "frames in which the body was measured",
            measured as f64 / FRAMES as f64 * 100.0,
            "%",
        );
        bench.report.median(
            "position error of a measurement by markers alone, median",
            errors_mm,
            "mm",
        );
        bench.report.median("time from a frame's end to the next plan, median", took_ms, "ms");
        Ok(())
    }

    /// Test without a body in view: the track must end once.
    fn body_out_of_sight(&mut self, bench: &mut Bench) -> anyhow::Result<()> {
        let frames =
            (self.resolved.pipeline.fusion.coast_s * 1.5 / INTERVAL.as_secs_f64()) as u64 + 5;
        let (mut lost, mut after) = (0, 0);
        for _ in 0..frames {
            let stamp = self.stamp();
            let told = self.fly(bench, stamp, &[])?;
            if told.lasts == 0 {
                return Ok(());
            }
            after += if lost > 0 { told.tracks.len() } else { 0 };
            lost +=
                told.tracks.iter().filter(|track| track.state == TrackState::Lost.code()).count();
            bench.pass(INTERVAL)?;
        }
        bench.report.holds(
            "a lost track says so at most once",
            TRACK_PAGE,
            lost <= 1 && after == 0,
            || format!("state lost came {lost} times, and {after} tracks after it"),
        );
        Ok(())
    }

    /// Malformed messages must not affect later ones.
    fn malformed(&mut self, bench: &mut Bench) -> anyhow::Result<()> {
        let stamp = self.stamp();
        let marker =
            DetectedMarker { rays_in_camera: [[2.0, 0.0, 0.0]; 4], ..DetectedMarker::default() };
        let lies = [
            (DetectionHeader { stamp, hits: 9, ..DetectionHeader::default() }, vec![]),
            (DetectionHeader { stamp, ..DetectionHeader::default() }, vec![marker]),
            (
                DetectionHeader {
                    stamp,
                    worker: 99,
                    view_index: u32::MAX,
                    ..DetectionHeader::default()
                },
                vec![],
            ),
        ];
        for (header, markers) in lies {
            self.records.send(header, &markers)?;
        }
        self.ends.send(FrameEnd { stamp, reason: 77, ..FrameEnd::default() }, &[])?;
        // A frame with a missing record must end by a timeout, also without later frames.
        let stamp = self.stamp();
        let end = FrameEnd {
            stamp,
            plan_id: self.plan_id,
            taken_ns: stamp.published_ns,
            ended_ns: clock::monotonic_ns(),
            views_issued: 1,
            ..FrameEnd::default()
        };
        self.ends.send(end, &[])?;
        let tracks = &mut self.tracks;
        let patience = self.resolved.pipeline.frame_deadline() + PATIENCE;
        let is_told = bench.wait(patience, |_| {
            let message = tracks.receive_with_verdict()?.map(|(message, _)| message.header);
            Ok(message.filter(|header| header.is_last != 0 && header.stamp.is_same_frame(&stamp)))
        })?;
        bench.report.holds(
            "a frame is given up after fusion.deadline_ms",
            PAGE,
            is_told.is_some(),
            || {
                format!(
                    "frame {}, of which a record is missing, was not ended in {} ms",
                    stamp.sequence,
                    patience.as_millis()
                )
            },
        );
        let stamp = self.stamp();
        let told = self.fly(bench, stamp, &[])?;
        bench.report.holds("malformed records cost nothing else", OWES, told.lasts == 1, || {
            "the next frame was not ended".to_owned()
        });
        Ok(())
    }
}

/// Pose of the body's markers in the camera frame at a time, seconds.
fn pose(at_s: f64) -> Isometry3<f64> {
    Isometry3::from_parts(
        Translation3::new(0.8 + 0.1 * at_s, 0.3 * (1.5 * at_s).sin(), 0.2),
        UnitQuaternion::from_euler_angles(0.1, 0.2, 0.6 * at_s),
    )
}

/// The view of each frame, towards the body.
fn view() -> View {
    View::looking_at(&Unit::new_normalize(pose(0.5).translation.vector), FIELD_RAD, VIEW_PX)
}

/// The detected markers of a body in frame `number`: those that face the camera, with errors as
/// stated.
fn markers(body: &Body, pose: &Isometry3<f64>, number: u64) -> Vec<DetectedMarker> {
    let eye = pose.inverse_transform_point(&Point3::origin());
    let facing = body
        .markers
        .iter()
        .filter(|marker| marker.normal().dot(&(eye - marker.centre()).normalize()) > 0.5);
    // With the factor sqrt(2) a sine has standard deviation 1. Irrational steps make all errors
    // different.
    let error = |id: u32, corner: usize, axis: usize| {
        let place =
            number as f64 * 0.618_034 + f64::from(id) * 0.414_214 + corner as f64 * 0.302_776;
        let phase = std::f64::consts::TAU * (place + axis as f64 * 0.236_068);
        DEVIATION_RAD * std::f64::consts::SQRT_2 * phase.sin()
    };
    let ray = |id: u32, corner: usize, at: &Point3<f64>| -> [f64; 3] {
        let seen = (pose * at).coords.normalize();
        (seen + Vector3::from_fn(|axis, _| error(id, corner, axis))).normalize().into()
    };
    let view = view();
    let found = facing.filter_map(|marker| {
        let rays = [0, 1, 2, 3].map(|k| ray(marker.id, k, &marker.corners[k]));
        let mut corners_in_view = [[0.0; 2]; 4];
        for (corner, ray) in corners_in_view.iter_mut().zip(&rays) {
            let pixel = view.project(&Unit::new_normalize(Vector3::from(*ray)))?.0;
            *corner = [pixel.x as f32, pixel.y as f32];
        }
        Some(DetectedMarker {
            rays_in_camera: rays,
            corners_in_view,
            deviations: [DEVIATION_RAD; 4],
            id: marker.id,
            ..DetectedMarker::default()
        })
    });
    found.collect()
}
