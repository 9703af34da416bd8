//! A rectification in place of Flockeye's own, in Rust.
//!
//!     cargo build --release -p my-rectifier
//!     flockeye swap rectification --accept-worse -- target/release/my-rectifier
//!
//! It needs equirectangular frames, and samples them pixel by pixel, without threads or tables: `sphere` is
//! the place for something better. It is slower than Flockeye's own, so fewer views of each frame are cut.

mod plan;
mod sphere;
mod workers;

use std::process::ExitCode;
use std::rc::Rc;

use anyhow::ensure;
use flockeye_config::{CameraModel, Flow, Resolved};
use flockeye_contract::{
    DetectionHeader, Detections, FrameEnd, FrameEnds, Frames, Plans, StageName, StopReason,
    ViewHeader, Views,
};
use flockeye_runtime::health::{Identity, SharedCounters};
use flockeye_runtime::listening::Listening;
use flockeye_runtime::logs::Throttle;
use flockeye_runtime::ports::{Message, Ports, Publisher, Subscriber};
use flockeye_runtime::{Context, Stage, Step, clock};

use crate::plan::{Plan, Progress};
use crate::sphere::{Sphere, turned};
use crate::workers::{GivenView, Workers};

/// A plan older than this is not followed: fusion has died since.
const STALE_PLAN_NS: i64 = 1_000_000_000;
/// How often it looks for views that are late.
const POLL_NS: i64 = 50_000_000;

/// A frame, kept until all of its views are answered.
struct Work {
    frame: Message<Frames>,
    plan: Plan,
    taken_ns: i64,
    issued: u32,
    has_hit: bool,
    is_ended: bool,
}

/// Takes up the newest frame, and gives its views to the workers as the newest plan says.
struct MyRectifier {
    identity: Identity,
    counters: SharedCounters,
    listening: Rc<Listening>,
    refusals: Throttle,
    resolved: Resolved,
    frames: Subscriber<Frames>,
    plans: Subscriber<Plans>,
    answers: Subscriber<Detections>,
    lanes: Vec<Publisher<Views>>,
    frame_ends: Publisher<FrameEnds>,
    workers: Workers,
    next_tile: usize,
    plan: Option<Plan>,
    waiting: Option<Message<Frames>>,
    work: Option<Work>,
}

impl Stage for MyRectifier {
    const NAME: &'static str = "rectification";

    fn open(context: &Context, ports: &mut Ports) -> anyhow::Result<Self> {
        let resolved = context.resolved.clone();
        let projection = resolved.pipeline.camera.projection;
        ensure!(
            projection == CameraModel::Equirectangular,
            "camera.projection is {projection:?}, and this rectification reads equirectangular frames"
        );
        context.counters.set_detail("my own sampling");
        let workers = resolved.pipeline.detection_workers() as usize;
        let lanes: Result<_, _> =
            (0..workers).map(|worker| ports.publisher_of_lane(worker)).collect();
        Ok(Self {
            frames: ports.subscriber()?,
            plans: ports.subscriber()?,
            answers: ports.subscriber()?,
            lanes: lanes?,
            frame_ends: ports.publisher()?,
            workers: Workers::new(workers, resolved.pipeline.rectification.window as usize),
            identity: context.identity.clone(),
            counters: context.counters.clone(),
            listening: ports.listening(),
            refusals: Throttle::default(),
            next_tile: 0,
            plan: None,
            waiting: None,
            work: None,
            resolved,
        })
    }

    fn step(&mut self) -> anyhow::Result<Step> {
        while let Some(plan) = self.plans.receive()? {
            self.on_plan(Plan { header: plan.header, views: plan.items().to_vec() });
        }
        while let Some(answer) = self.answers.receive()? {
            self.on_answer(&answer.header);
        }
        // In a lossless run no frame is left out.
        if !(self.is_lossless() && self.waiting.is_some()) {
            self.waiting = self.frames.newest()?.or(self.waiting.take());
        }
        if self.work.is_none()
            && let Some(frame) = self.waiting.take()
        {
            self.take_up(frame);
        }
        Ok(match self.advance()? {
            true => Step::Again,
            false => Step::WaitUntil(clock::monotonic_ns() + POLL_NS),
        })
    }
}

impl MyRectifier {
    fn is_lossless(&self) -> bool {
        self.resolved.pipeline.flow == Flow::Lossless
    }

    fn refuse(&mut self, what: &str) {
        self.counters.add_failed(1);
        if let Some(more) = self.refusals.admit() {
            eprintln!("refused ({more} more since): {what}");
        }
    }

    fn on_plan(&mut self, plan: Plan) {
        let largest_px = self.resolved.largest_view_px();
        match plan.views.iter().find(|view| view.size_px > largest_px) {
            Some(view) => {
                let size_px = view.size_px;
                self.refuse(&format!("a view of {size_px} px, where {largest_px} px are the most"));
            }
            None => self.plan = Some(plan),
        }
    }

    fn on_answer(&mut self, answer: &DetectionHeader) {
        self.workers.has_spoken(answer.worker);
        if let Some(work) = &mut self.work
            && work.frame.header.stamp.is_same_frame(&answer.stamp)
            && self.workers.is_answered(answer.view_index, answer.attempt)
        {
            work.has_hit |= answer.hits > 0;
        }
    }

    fn take_up(&mut self, frame: Message<Frames>) {
        let camera = &self.resolved.pipeline.camera;
        let (found, configured) =
            ([frame.header.width, frame.header.height], [camera.width, camera.height]);
        if found != configured {
            self.refuse(&format!(
                "a frame of {found:?} pixels, where {configured:?} are configured"
            ));
            return;
        }
        let taken_ns = clock::monotonic_ns();
        let is_followed =
            |plan: &&Plan| self.is_lossless() || plan.header.made_ns > taken_ns - STALE_PLAN_NS;
        let plan = self.plan.as_ref().filter(is_followed).cloned();
        let plan = plan.unwrap_or_else(|| {
            self.next_tile += 1;
            Plan::sweep(&self.resolved, self.next_tile - 1)
        });
        self.work =
            Some(Work { frame, plan, taken_ns, issued: 0, has_hit: false, is_ended: false });
    }

    /// Does one piece of work for the frame; false if there is nothing to do but to wait.
    fn advance(&mut self) -> anyhow::Result<bool> {
        let Some(work) = &mut self.work else { return Ok(false) };
        let overdue_ns = self.resolved.pipeline.view_overdue().as_nanos() as i64;
        if let Some((late, silence)) = self.workers.take_late(clock::monotonic_ns() - overdue_ns) {
            let (stage, worker) = (StageName::Detection, late.worker as u32);
            self.listening.complain_of_silence(stage, worker, silence, "a view is not answered");
            // An ended frame makes room for a newer one: nobody needs its view any more.
            if !(work.is_ended && self.waiting.is_some()) {
                let worker = self.workers.other_than(late.worker);
                self.give(late.index, late.attempt + 1, worker)?;
            }
            return Ok(true);
        }
        if work.is_ended {
            let is_over = self.workers.is_idle();
            self.work.take_if(|_| is_over);
            return Ok(is_over);
        }
        let so_far = Progress {
            issued: work.issued,
            has_hit: work.has_hit,
            is_newer_there: self.waiting.is_some(),
            is_lossless: self.resolved.pipeline.flow == Flow::Lossless,
        };
        if let Some(reason) = work.plan.reason_to_stop(&so_far) {
            work.is_ended = true;
            self.send_end(reason)?;
            return Ok(true);
        }
        let Some(worker) = self.workers.next() else { return Ok(false) };
        work.issued += 1;
        self.give(so_far.issued, 0, worker)?;
        Ok(true)
    }

    /// Cuts a view into the memory of the worker's lane.
    fn give(&mut self, index: u32, attempt: u32, worker: usize) -> anyhow::Result<()> {
        let Some(work) = &self.work else { return Ok(()) };
        let (frame, planned) = (&work.frame.header, &work.plan.views[index as usize]);
        let size_px = planned.size_px;
        let camera_from_view = turned(planned, frame.stamp.exposure_ns);
        let lane = &self.lanes[worker];
        let mut loan = lane.loan(size_px as usize * size_px as usize)?;
        let sphere = Sphere::new(frame, work.frame.items());
        sphere.cut(&camera_from_view, planned.focal_px, size_px, loan.items_mut());
        let issued_ns = clock::monotonic_ns();
        loan.send(ViewHeader {
            stamp: frame.stamp,
            plan_id: work.plan.header.plan_id,
            taken_ns: work.taken_ns,
            issued_ns,
            camera_from_view: camera_from_view.coords.into(),
            focal_px: planned.focal_px,
            predicted_camera_from_markers: planned.predicted_camera_from_markers,
            readout_ns: frame.readout_ns,
            generation: self.identity.generation,
            view_index: index,
            attempt,
            worker: worker as u32,
            size_px,
            stride: size_px,
            kind: planned.kind,
            tile: planned.tile,
            target: planned.target,
            has_prediction: planned.has_prediction,
            transfer: frame.transfer,
            gamma: frame.gamma,
            range: frame.range,
            search: planned.search,
        })?;
        self.workers.give(GivenView { index, attempt, worker, given_ns: issued_ns });
        Ok(())
    }

    fn send_end(&self, reason: StopReason) -> anyhow::Result<()> {
        let Some(work) = &self.work else { return Ok(()) };
        let end = FrameEnd {
            stamp: work.frame.header.stamp,
            plan_id: work.plan.header.plan_id,
            taken_ns: work.taken_ns,
            ended_ns: clock::monotonic_ns(),
            views_issued: work.issued,
            views_abandoned: (work.plan.views.len() as u32).saturating_sub(work.issued),
            reason: reason.code(),
            generation: self.identity.generation,
        };
        Ok(self.frame_ends.send(end, &[])?)
    }
}

fn main() -> ExitCode {
    flockeye_runtime::stage::main::<MyRectifier>()
}
