//! Test of a rectification stage: a sphere with known brightness, plans, and answers of workers.

use std::time::Duration;

use flockeye_config::Resolved;
use flockeye_contract::{
    DetectedMarker, DetectionHeader, Detections, FrameEnd, FrameEnds, FrameHeader, FrameStamp,
    Frames, NONE, PlanHeader, PlannedView, Plans, StopReason, StopRule, Transfer, ViewHeader,
    ViewKind, Views,
};
use flockeye_convert::rotation;
use flockeye_geometry::view::View;
use flockeye_runtime::clock;
use flockeye_runtime::ports::{Publisher, Subscriber};
use nalgebra::{UnitQuaternion, Vector3};

use super::bench::Bench;
use super::pictures;
use super::report::ConformanceReport;

mod malformed;

const PAGE: &str = "Rectification (frame, plan, detection to view, frame_end)";

/// Timeout for a frame from its publication to its end.
const PATIENCE: Duration = Duration::from_secs(5);
/// Number of frames without an end in time after which the test waits only briefly.
const MOST_UNANSWERED: u32 = 2;
/// Time for the candidate to receive malformed messages.
const TAKEN_UP: Duration = Duration::from_millis(100);
/// Age of a stale plan.
const STALE: Duration = Duration::from_millis(1200);
/// Largest mean difference between a view's pixels and the sphere along their rays, levels.
const MEAN_ERROR_LEVELS: f64 = 1.0;
/// Largest error of a view's direction that is turned by its rate, radians.
const TURN_ERROR_RAD: f64 = 1e-6;
/// Angular velocity of planned views, rad/s.
const RATE: [f64; 3] = [0.2, -0.4, 0.9];

/// A received view.
struct LaneView {
    header: ViewHeader,
    lane: usize,
    error_levels: f64,
}

/// The views and the end of a frame.
#[derive(Default)]
struct FrameCuts {
    views: Vec<LaneView>,
    end: Option<FrameEnd>,
}

struct Script<'r> {
    resolved: &'r Resolved,
    /// A frame without its stamp.
    shape: FrameHeader,
    frames: Publisher<Frames>,
    plans: Publisher<Plans>,
    records: Publisher<Detections>,
    views: Vec<Subscriber<Views>>,
    ends: Subscriber<FrameEnds>,
    picture: Vec<u8>,
    sequence: u64,
    plan_id: u64,
    unanswered: u32,
}

/// Tests the candidate.
pub(crate) fn run(bench: &mut Bench, resolved: &Resolved) -> anyhow::Result<()> {
    let mut script = Script {
        resolved,
        shape: pictures::frame_shape(resolved, Transfer::Linear)?,
        frames: bench.ports.publisher()?,
        plans: bench.ports.publisher()?,
        records: bench.ports.publisher()?,
        views: bench.ports.subscribers_of_all_lanes()?,
        ends: bench.ports.subscriber()?,
        picture: Vec::new(),
        sequence: 0,
        plan_id: 0,
        unanswered: 0,
    };
    script.picture = pictures::sphere(&script.shape);
    script.sweep(bench)?;
    script.planned(bench)?;
    script.first_hit(bench)?;
    script.silent_worker(bench)?;
    script.malformed(bench)?;
    bench.pass(Duration::from_millis(800))?;
    Ok(())
}

/// The learned response of a plan: every second one has it, and a view without a plan has none.
fn gamma_of_plan(plan_id: u64) -> f32 {
    if plan_id > 0 && plan_id.is_multiple_of(2) { 1.4 } else { 0.0 }
}

impl Script<'_> {
    fn frame(&mut self) -> FrameHeader {
        let now_ns = clock::monotonic_ns();
        self.sequence += 1;
        FrameHeader {
            stamp: FrameStamp {
                sequence: self.sequence,
                exposure_ns: now_ns - 1_000_000,
                stream_ns: now_ns,
                published_ns: now_ns,
                ..FrameStamp::default()
            },
            ..self.shape
        }
    }

    /// Sends a plan of the first `count` tiles, which turn.
    fn plan(&mut self, count: usize, rule: StopRule) -> anyhow::Result<Vec<PlannedView>> {
        self.plan_id += 1;
        let now_ns = clock::monotonic_ns();
        let tiles = self.resolved.partition_views.iter().cycle().zip(0..).take(count);
        let planned: Vec<PlannedView> = tiles
            .map(|(view, tile)| PlannedView {
                camera_from_view: view.camera_from_view.coords.into(),
                rate_in_camera: RATE,
                reference_ns: now_ns,
                focal_px: view.focal_px,
                size_px: view.size_px,
                kind: ViewKind::Partition.code(),
                tile,
                target: NONE,
                search: tile % 3,
                ..PlannedView::default()
            })
            .collect();
        let header = PlanHeader {
            plan_id: self.plan_id,
            made_ns: now_ns,
            stop_rule: rule.code(),
            view_budget: count as u32,
            gamma: gamma_of_plan(self.plan_id),
            ..PlanHeader::default()
        };
        self.plans.send(header, &planned)?;
        Ok(planned)
    }

    /// Sends a frame, and answers its views until it has ended and all are answered. `answer`
    /// returns the number of hits, or `None` for no answer.
    fn fly(
        &mut self,
        bench: &mut Bench,
        mut answer: impl FnMut(&ViewHeader) -> Option<u32>,
    ) -> anyhow::Result<(FrameHeader, FrameCuts)> {
        let frame = self.frame();
        self.frames.send(frame, &self.picture)?;
        let mut told = FrameCuts::default();
        let mut open = 0;
        let (views, ends, records) = (&mut self.views, &mut self.ends, &self.records);
        let patience = if self.unanswered < MOST_UNANSWERED { PATIENCE } else { TAKEN_UP };
        let ended = bench.wait(patience, |bench| {
            for (lane, views) in views.iter_mut().enumerate() {
                while let Some((message, verdict)) = views.receive_with_verdict()? {
                    let is_whole = verdict.is_ok();
                    bench.report.verdict("views pass the contract's check", verdict);
                    if !is_whole || !message.header.stamp.is_same_frame(&frame.stamp) {
                        continue;
                    }
                    let header = message.header;
                    let error_levels = error_levels(&header, message.items());
                    told.views.push(LaneView { header, lane, error_levels });
                    match answer(&header) {
                        Some(hits) => records.send(answer_to(&header, hits), &markers(hits))?,
                        None => open += 1,
                    }
                }
            }
            while let Some((message, verdict)) = ends.receive_with_verdict()? {
                let is_whole = verdict.is_ok();
                bench.report.verdict("frame ends pass the contract's check", verdict);
                if is_whole && message.header.stamp.is_same_frame(&frame.stamp) {
                    let is_second = told.end.replace(message.header).is_some();
                    bench.report.holds("one frame_end for each frame", PAGE, !is_second, || {
                        format!("frame {} ended twice", frame.stamp.sequence)
                    });
                }
            }
            let issued = told.end.map(|end| end.views_issued as usize);
            let answered = told.views.len() - open;
            Ok(issued.is_some_and(|issued| answered >= issued).then_some(()))
        })?;
        self.unanswered += u32::from(ended.is_none());
        bench.report.holds("one frame_end for each frame", PAGE, told.end.is_some(), || {
            format!("frame {} got none in {} ms", frame.stamp.sequence, patience.as_millis())
        });
        self.check_views(&mut bench.report, &frame, &told);
        Ok((frame, told))
    }

    fn check_views(&self, report: &mut ConformanceReport, frame: &FrameHeader, told: &FrameCuts) {
        for LaneView { header, lane, error_levels } in &told.views {
            report.field(
                "views lie in their worker's lane",
                PAGE,
                "worker",
                header.worker as usize,
                *lane,
            );
            report.field("views say whose they are", PAGE, "generation", header.generation, 0);
            let gamma = gamma_of_plan(header.plan_id);
            let (transfer, gamma) = match gamma > 0.0 {
                true => (Transfer::Gamma.code(), gamma),
                false => (frame.transfer, frame.gamma),
            };
            report.field("views have the plan's response", PAGE, "gamma", header.gamma, gamma);
            let copied =
                [("transfer", header.transfer, transfer), ("range", header.range, frame.range)];
            for (field, found, wanted) in copied {
                report.field("fields are copied from the frame", PAGE, field, found, wanted);
            }
            report.field(
                "fields are copied from the frame",
                PAGE,
                "stamp",
                header.stamp,
                frame.stamp,
            );
            report.holds("pixels lie along the rays that the view states", PAGE, *error_levels < MEAN_ERROR_LEVELS, || {
                format!(
                    "the pixels of view_index {} differ by {error_levels:.1} levels in the mean; {MEAN_ERROR_LEVELS} may be",
                    header.view_index
                )
            });
        }
        let Some(end) = &told.end else { return };
        let first_cuts: Vec<u32> = told
            .views
            .iter()
            .filter(|cut| cut.header.attempt == 0)
            .map(|cut| cut.header.view_index)
            .collect();
        let mut sorted = first_cuts;
        sorted.sort_unstable();
        let is_counted = sorted.iter().copied().eq(0..end.views_issued);
        report.holds("views_issued counts the views", PAGE, is_counted, || {
            format!("views_issued is {}, and the views' indices are {sorted:?}", end.views_issued)
        });
        let last_ns = told
            .views
            .iter()
            .filter(|cut| cut.header.attempt == 0)
            .map(|cut| cut.header.issued_ns)
            .max();
        report.holds(
            "a frame ends after its last view",
            PAGE,
            last_ns.is_none_or(|last| end.ended_ns >= last),
            || {
                format!(
                    "ended_ns is {} ms before the last view's issued_ns",
                    last_ns.unwrap_or(0).saturating_sub(end.ended_ns) / 1_000_000
                )
            },
        );
    }

    /// Test without a plan: the candidate sweeps.
    fn sweep(&mut self, bench: &mut Bench) -> anyhow::Result<()> {
        let (_, told) = self.fly(bench, |_| Some(0))?;
        for cut in &told.views {
            bench.report.field(
                "without a plan it sweeps by plan_id 0",
                PAGE,
                "plan_id",
                cut.header.plan_id,
                0,
            );
        }
        bench.report.holds(
            "without a plan it sweeps by plan_id 0",
            PAGE,
            !told.views.is_empty(),
            || "no view was cut".to_owned(),
        );
        Ok(())
    }

    /// Test with plans: they are followed, and their views turn with the camera.
    fn planned(&mut self, bench: &mut Bench) -> anyhow::Result<()> {
        let mut took_ms = Vec::new();
        for _ in 0..10 {
            let planned = self.plan(4, StopRule::All)?;
            let (frame, told) = self.fly(bench, |_| Some(0))?;
            if !bench.runs() {
                return Ok(());
            }
            let Some(end) = told.end else { return Ok(()) };
            bench.report.field(
                "a plan is followed to its end",
                PAGE,
                "views_issued",
                end.views_issued,
                4,
            );
            bench.report.field(
                "a plan is followed to its end",
                PAGE,
                "reason",
                end.reason,
                StopReason::Complete.code(),
            );
            bench.report.field(
                "a plan is followed to its end",
                PAGE,
                "plan_id",
                end.plan_id,
                self.plan_id,
            );
            took_ms.push(end.ended_ns.saturating_sub(end.taken_ns) as f64 * 1e-6);
            for cut in &told.views {
                let header = &cut.header;
                let Some(planned) = planned.get(header.view_index as usize) else { continue };
                for (field, found, wanted) in [
                    ("kind", header.kind, planned.kind),
                    ("tile", header.tile, planned.tile),
                    ("target", header.target, planned.target),
                    ("search", header.search, planned.search),
                    ("size_px", header.size_px, planned.size_px),
                ] {
                    bench.report.field(
                        "fields are copied from the plan",
                        PAGE,
                        field,
                        found,
                        wanted,
                    );
                }
                let since_s =
                    frame.stamp.exposure_ns.saturating_sub(planned.reference_ns) as f64 * 1e-9;
                let turn = UnitQuaternion::from_scaled_axis(Vector3::from(RATE) * since_s);
                let wanted = turn * rotation(planned.camera_from_view);
                let off_rad = wanted.angle_to(&rotation(header.camera_from_view));
                bench.report.holds(
                    "views are turned to the exposure",
                    PAGE,
                    off_rad < TURN_ERROR_RAD,
                    || {
                        format!(
                            "camera_from_view of view_index {} is {:.3} mrad off",
                            header.view_index,
                            off_rad * 1e3
                        )
                    },
                );
            }
        }
        bench.report.median("time for a frame of 4 views, median", took_ms, "ms");
        Ok(())
    }

    /// Test of the rule that the search stops at a hit.
    fn first_hit(&mut self, bench: &mut Bench) -> anyhow::Result<()> {
        let window = self.resolved.pipeline.rectification.window;
        let in_flight = window * self.resolved.pipeline.detection_workers();
        let count = in_flight as usize + 6;
        self.plan(count, StopRule::FirstHit)?;
        let (_, told) = self.fly(bench, |_| Some(1))?;
        if let Some(end) = told.end {
            bench.report.field(
                "first_hit stops at a hit",
                PAGE,
                "reason",
                end.reason,
                StopReason::Hit.code(),
            );
            let (issued, abandoned) = (end.views_issued, end.views_abandoned);
            bench.report.holds("first_hit stops at a hit", PAGE, (issued as usize) < count, || {
                format!("views_issued is {issued} although the first view had a hit")
            });
            bench.report.field(
                "views_abandoned counts the rest",
                PAGE,
                "views_abandoned",
                abandoned,
                (count as u32).saturating_sub(issued),
            );
        }
        Ok(())
    }

    /// Test of a worker without answers: another worker gets its views.
    fn silent_worker(&mut self, bench: &mut Bench) -> anyhow::Result<()> {
        if self.views.len() < 2 {
            return Ok(());
        }
        self.plan(2, StopRule::All)?;
        let (_, told) = self.fly(bench, |view| (view.worker != 0).then_some(0))?;
        let of_silent = told.views.iter().filter(|cut| cut.header.worker == 0);
        for lost in of_silent {
            let (index, attempt) = (lost.header.view_index, lost.header.attempt);
            let again = told.views.iter().find(|cut| {
                cut.header.view_index == index
                    && cut.header.worker != 0
                    && cut.header.attempt > attempt
            });
            bench.report.holds("a silent worker's views go to others", PAGE, again.is_some(), || {
                format!("view_index {index} of worker 0 was never cut for another worker, with a higher attempt")
            });
        }
        Ok(())
    }
}

/// Mean difference between a view's pixels and the sphere along their rays, over some of the
/// pixels.
fn error_levels(header: &ViewHeader, pixels: &[u8]) -> f64 {
    let view = View {
        camera_from_view: rotation(header.camera_from_view),
        focal_px: header.focal_px,
        size_px: header.size_px,
    };
    let middle = f64::from(header.size_px - 1) / 2.0;
    let step = (header.size_px / 40).max(1) as usize;
    let (mut sum, mut count) = (0.0, 0.0);
    for v in (0..header.size_px).step_by(step) {
        for u in (0..header.size_px).step_by(step) {
            let [x, y] = [u, v].map(|at| (f64::from(at) - middle) / view.focal_px);
            let ray = view.camera_from_view * Vector3::new(x, y, 1.0).normalize();
            let found = f64::from(pixels[(v * header.stride + u) as usize]);
            sum += (found - pictures::level(&ray)).abs();
            count += 1.0;
        }
    }
    sum / count
}

fn answer_to(view: &ViewHeader, hits: u32) -> DetectionHeader {
    let now_ns = clock::monotonic_ns();
    DetectionHeader {
        received_ns: now_ns,
        sent_ns: now_ns,
        worker: view.worker,
        hits,
        ..DetectionHeader::answering(view)
    }
}

/// A list of `count` markers.
fn markers(count: u32) -> Vec<DetectedMarker> {
    let marker = |id| DetectedMarker {
        rays_in_camera: [[1.0, 0.0, 0.0]; 4],
        deviations: [1e-3; 4],
        id,
        ..DetectedMarker::default()
    };
    (0..count).map(marker).collect()
}
