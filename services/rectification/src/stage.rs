//! The ports around rectification.

use std::collections::BTreeSet;
use std::time::Duration;

use anyhow::Context as _;
use flockeye_config::{Backend, Flow, Resolved};
use flockeye_contract::{
    Detections, FrameEnd, FrameEnds, FrameHeader, FrameStamp, Frames, PlanHeader, PlannedView,
    Plans, StopReason, StopRule, ViewHeader, Views,
};
use flockeye_convert::{projection_of, xyzw};
use flockeye_geometry::camera::Camera;
use flockeye_geometry::view::View;
use flockeye_imaging::sphere::{Cut, Interpolation, SphereImage};
use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::logs::Throttle;
use flockeye_runtime::ports::{Message, Ports, Publisher, Subscriber};
use flockeye_runtime::{Context, Stage, Step, clock};
use nalgebra::Vector3;

use crate::backend::{BackendChoice, choose_backend};
use crate::cadence::Cadence;
use crate::dispatch::{Answer, Dispatcher};
use crate::job::{Job, Next, sweep};
use crate::rectifier::{FrameKey, Rectifier as _};
use crate::standby::Standby;

/// A plan older than this is fusion's last word before it died, nanoseconds.
const STALE_PLAN_NS: i64 = 1_000_000_000;

/// Frames held at once: one that waits for its answers, and the one that is being cut.
const HELD_FRAMES: usize = 2;

/// Takes frames, plans and detections (as acknowledgements); gives views and frame ends.
pub struct RectificationStage {
    frames: Subscriber<Frames>,
    plans: Subscriber<Plans>,
    detections: Subscriber<Detections>,
    /// One for each worker.
    views: Vec<Publisher<Views>>,
    frame_ends: Publisher<FrameEnds>,
    rectifier: Standby,
    workers: usize,
    dispatcher: Dispatcher<ViewKey>,
    overdue: Duration,
    flow: Flow,
    generation: u32,
    camera: Camera,
    /// Those of which the camera sees something, with their numbers.
    partitions: Vec<(u32, View)>,
    swept: usize,
    /// Partitions that the frame which ended last came to.
    searched: usize,
    plan: Option<(PlanHeader, Vec<PlannedView>)>,
    waiting: Option<Message<Frames>>,
    cadence: Cadence,
    held: Vec<Held>,
    counters: SharedCounters,
    failures: Throttle,
    refusals: Throttle,
    silence: Throttle,
    last_frame_ns: i64,
}

/// A source that sends nothing for this long is worth a word, nanoseconds.
const SILENCE_NS: i64 = 5_000_000_000;

/// Generation, epoch and sequence of a frame, and the place of a view in its plan.
type ViewKey = ((u32, u32, u64), u32);

struct Held {
    message: Message<Frames>,
    job: Job,
    /// Views that the rectifier was told of.
    ordered: BTreeSet<u32>,
}

impl Stage for RectificationStage {
    const NAME: &'static str = "rectification";

    fn open(context: &Context, ports: &mut Ports) -> anyhow::Result<Self> {
        let resolved = &context.resolved;
        let pipeline = &resolved.pipeline;
        let settings = &pipeline.rectification;
        let choice = match settings.backend {
            Backend::Auto => BackendChoice::Auto,
            Backend::Cpu => BackendChoice::Cpu,
            Backend::Gpu => BackendChoice::Gpu,
        };
        let camera = resolved.camera;
        let threads = settings.threads as usize;
        let (rectifier, why) = choose_backend(choice, threads, &camera)?;
        tracing::info!("views are cut by {}: {why}", rectifier.name());
        let workers = pipeline.detection_workers() as usize;
        let overdue = pipeline.view_overdue();
        Ok(Self {
            frames: ports.subscriber()?,
            plans: ports.subscriber()?,
            detections: ports.subscriber()?,
            views: (0..workers)
                .map(|worker| ports.publisher_of_lane(worker))
                .collect::<Result<_, _>>()?,
            frame_ends: ports.publisher()?,
            rectifier: Standby::new(rectifier, threads, context.counters.clone()),
            workers,
            dispatcher: Dispatcher::new(workers, settings.window as usize)
                .with_probe_after(overdue / 2),
            overdue,
            flow: pipeline.flow,
            generation: context.identity.generation,
            camera,
            partitions: seen_partitions(resolved)?,
            swept: 0,
            searched: 0,
            plan: None,
            waiting: None,
            cadence: Cadence::default(),
            held: Vec::new(),
            counters: context.counters.clone(),
            failures: Throttle::default(),
            refusals: Throttle::default(),
            silence: Throttle::default(),
            last_frame_ns: clock::monotonic_ns(),
        })
    }

    fn step(&mut self) -> anyhow::Result<Step> {
        // A lossless source sends a frame after it has the plan for it, so frames come first.
        self.receive_frame()?;
        self.note_silence();
        if let Some(message) = self.plans.newest()? {
            self.plan = Some((message.header, message.items().to_vec()));
        }
        self.receive_answers()?;
        for (frame, index) in self.dispatcher.overdue(now(), self.overdue) {
            let held = self.held.iter_mut().find(|held| held.job.frame.stamp.order() == frame);
            if let Some(held) = held {
                held.job.take_back(index);
            }
        }
        self.release();
        self.take_up()?;
        self.prepare_next();
        let has_cut = self.cut_next()?;
        self.counters.set_queued(self.dispatcher.outstanding());
        Ok(match (has_cut, self.held.is_empty()) {
            (true, _) => Step::Again,
            (false, true) => Step::Wait,
            // Somebody may have to be given up on.
            (false, false) => {
                Step::WaitUntil(clock::monotonic_ns() + self.overdue.as_nanos() as i64 / 4)
            }
        })
    }

    fn drain(&mut self) -> anyhow::Result<()> {
        for held in &mut self.held {
            if !held.job.has_ended() {
                end(&self.frame_ends, &mut held.job, StopReason::Shutdown, self.generation)?;
            }
        }
        Ok(())
    }
}

impl RectificationStage {
    fn receive_frame(&mut self) -> anyhow::Result<()> {
        if self.flow == Flow::Lossless {
            if self.waiting.is_none() {
                self.waiting = self.frames.receive()?;
            }
            return Ok(());
        }
        while let Some(newer) = self.frames.receive()? {
            self.cadence.note(&newer.header.stamp, clock::monotonic_ns());
            if self.waiting.replace(newer).is_some() {
                self.counters.add_dropped(1);
            }
        }
        Ok(())
    }

    fn note_silence(&mut self) {
        let now_ns = clock::monotonic_ns();
        if self.waiting.is_some() || !self.held.is_empty() {
            self.last_frame_ns = now_ns;
        } else if now_ns - self.last_frame_ns > SILENCE_NS
            && let Some(_) = self.silence.admit()
        {
            let seconds = (now_ns - self.last_frame_ns) / 1_000_000_000;
            tracing::warn!("no frame has come for {seconds} s: the source is away, or at its end");
        }
    }

    fn receive_answers(&mut self) -> anyhow::Result<()> {
        while let Some(message) = self.detections.receive()? {
            let header = message.header;
            let order = header.stamp.order();
            let key = (order, header.view_index);
            let answer =
                self.dispatcher.acknowledged(key, header.worker as usize, header.attempt, now());
            let held = self.held.iter_mut().find(|held| held.job.frame.stamp.order() == order);
            if let (Answer::First, Some(held)) = (answer, held) {
                held.job.note_answer(header.view_index, header.hits > 0);
                if held.job.is_tile(header.view_index) {
                    self.cadence.note_search(header.sent_ns.saturating_sub(header.received_ns));
                }
            }
        }
        Ok(())
    }

    /// Gives back frames of which nothing more is to come.
    fn release(&mut self) {
        self.held.retain(|held| !held.job.is_done());
    }

    /// Takes up the frame that waits, once the one before has been cut.
    fn take_up(&mut self) -> anyhow::Result<()> {
        let is_cutting = self.held.iter().any(|held| !held.job.has_ended());
        if is_cutting || self.held.len() >= HELD_FRAMES {
            return Ok(());
        }
        let Some(message) = self.waiting.take() else { return Ok(()) };
        let header = message.header;
        let job = self.job_for(header);
        let mut held = Held { message, job, ordered: BTreeSet::new() };
        let likely = held.job.likely(self.searched);
        match order(&mut self.rectifier, self.camera, &mut held, &likely) {
            Ok(()) => self.held.push(held),
            Err(error) => {
                // Whoever waits for this frame's end gets it.
                end(&self.frame_ends, &mut held.job, StopReason::Failed, self.generation)?;
                self.counters.add_failed(1);
                if let Some(more) = self.refusals.admit() {
                    tracing::warn!(
                        frame = header.stamp.sequence,
                        more_since = more,
                        "frame refused: {error:#}"
                    );
                }
            }
        }
        Ok(())
    }

    /// Lets the frame that waits be uploaded while another is being cut.
    fn prepare_next(&mut self) {
        let Some(message) = &self.waiting else { return };
        let prepared = sphere_of(self.camera, &message.header, message.items())
            .and_then(|sphere| Ok(self.rectifier.prepare(key(&message.header.stamp), &sphere)?));
        if let Err(error) = prepared {
            // A warning follows if it is taken up.
            tracing::debug!("a frame cannot be prepared: {error:#}");
        }
    }

    fn job_for(&mut self, header: FrameHeader) -> Job {
        let now_ns = clock::monotonic_ns();
        let is_live = |plan: &PlanHeader| {
            self.flow == Flow::Lossless || now_ns - plan.made_ns < STALE_PLAN_NS
        };
        if let Some((plan, views)) = self.plan.as_ref().filter(|(plan, _)| is_live(plan)) {
            // Checked when it was received; an unknown rule cannot get here.
            let rule = StopRule::try_from(plan.stop_rule).unwrap_or(StopRule::Deadline);
            let budget = match self.flow {
                Flow::Lossless => plan.view_budget as usize,
                Flow::Latest => usize::MAX,
            };
            return Job::new(header, plan.plan_id, views.clone(), rule, budget, now_ns);
        }
        let views = sweep(&self.partitions, self.swept);
        Job::new(header, 0, views, StopRule::Deadline, usize::MAX, now_ns)
    }

    /// Cuts one view, or ends a frame. False if there is nothing to do before something arrives.
    fn cut_next(&mut self) -> anyhow::Result<bool> {
        let is_time_over = || !self.cadence.has_time_to_cut(clock::monotonic_ns());
        let is_newer_due = self.flow == Flow::Latest && (self.waiting.is_some() || is_time_over());
        for position in 0..self.held.len() {
            let job = &self.held[position].job;
            // Newcomers are found however little time there is.
            let is_owed = self.cadence.owes_partition() && job.searched() == 0;
            match job.next(is_newer_due && !is_owed) {
                Next::Wait => {}
                Next::End(reason) => {
                    self.end(position, reason)?;
                    return Ok(true);
                }
                Next::Cut { index, is_yielding } => {
                    let Some(worker) = self.dispatcher.next_worker(now()) else { continue };
                    if is_yielding && !self.has_room_for_partition() {
                        continue;
                    }
                    if let Err(error) = self.cut(position, index, worker) {
                        self.counters.add_failed(1);
                        if let Some(more) = self.failures.admit() {
                            tracing::warn!(more_since = more, "a view cannot be cut: {error:#}");
                        }
                        self.end(position, StopReason::Failed)?;
                    }
                    return Ok(true);
                }
            }
        }
        Ok(false)
    }

    /// Whether another partition may be on its way to the workers. One of them stays free of partitions, and
    /// a single one gets one at a time, since they would hold up the next frame's neighbours; one more is cut
    /// ahead while it and the one before will have been searched by then. In a lossless run nothing is held
    /// up.
    fn has_room_for_partition(&self) -> bool {
        let is_ahead = self.cadence.has_time_to_cut_ahead(clock::monotonic_ns());
        let most = self.workers.saturating_sub(1).max(1) + usize::from(is_ahead);
        self.flow == Flow::Lossless || self.dispatcher.outstanding() < most
    }

    fn cut(&mut self, position: usize, index: u32, worker: usize) -> anyhow::Result<()> {
        if !self.held[position].ordered.contains(&index) {
            let held = &mut self.held[position];
            let rest: Vec<u32> = held.job.from(index).collect();
            order(&mut self.rectifier, self.camera, held, &rest)?;
        }
        let Held { message, job, .. } = &self.held[position];
        let frame = message.header;
        let (view, planned) = job.view(index).context("it is not in the plan")?;
        let sphere = sphere_of(self.camera, &frame, message.items())?;
        let begun_ns = clock::monotonic_ns();
        let size = view.size_px as usize;
        let publisher = self.views.get(worker).context("there is no such worker")?;
        let mut loan = publisher.loan(size * size)?;
        let cut = cut_of(view, &planned, &self.camera);
        self.rectifier.cut(key(&frame.stamp), &sphere, &cut, loan.items_mut())?;
        let key = (frame.stamp.order(), index);
        let issued_ns = clock::monotonic_ns();
        let header = ViewHeader {
            stamp: frame.stamp,
            plan_id: job.plan_id,
            taken_ns: job.taken_ns,
            issued_ns,
            camera_from_view: xyzw(&view.camera_from_view),
            focal_px: view.focal_px,
            predicted_camera_from_markers: planned.predicted_camera_from_markers,
            readout_ns: frame.readout_ns,
            generation: self.generation,
            view_index: index,
            attempt: self.dispatcher.issued(key, worker, now()),
            worker: worker as u32,
            size_px: view.size_px,
            stride: view.size_px,
            kind: planned.kind,
            tile: planned.tile,
            target: planned.target,
            has_prediction: planned.has_prediction,
            transfer: frame.transfer,
            gamma: frame.gamma,
            range: frame.range,
            search: planned.search,
        };
        loan.send(header)?;
        self.counters.add_latency_ns(issued_ns - job.taken_ns);
        if job.is_tile(index) {
            self.cadence.note_cut(issued_ns - begun_ns);
        }
        self.held[position].job.note_issued(index);
        Ok(())
    }

    fn end(&mut self, position: usize, reason: StopReason) -> anyhow::Result<()> {
        let job = &mut self.held[position].job;
        if job.has_ended() {
            // A view that could not be cut again: the frame's end is out, its answer never comes.
            let given_up = job.frame.stamp.order();
            self.dispatcher.retain(|(frame, _)| frame != given_up);
            self.held.remove(position);
            return Ok(());
        }
        self.searched = job.searched();
        self.cadence.note_end(self.searched);
        if job.plan_id == 0 {
            self.swept = (self.swept + job.tally().0 as usize) % self.partitions.len().max(1);
        }
        end(&self.frame_ends, job, reason, self.generation)
    }
}

/// Tells the rectifier of views of a frame that will be cut.
fn order(
    rectifier: &mut Standby,
    camera: Camera,
    held: &mut Held,
    views: &[u32],
) -> anyhow::Result<()> {
    let Held { message, job, ordered } = held;
    let sphere = sphere_of(camera, &message.header, message.items())?;
    let cuts: Vec<Cut> = views
        .iter()
        .filter(|index| !ordered.contains(index))
        .filter_map(|&index| job.view(index))
        .map(|(view, planned)| cut_of(view, &planned, &camera))
        .collect();
    rectifier.order(key(&message.header.stamp), &sphere, &cuts)?;
    ordered.extend(views);
    Ok(())
}

fn key(stamp: &FrameStamp) -> FrameKey {
    let (source_generation, epoch, sequence) = stamp.order();
    FrameKey { source_generation, epoch, sequence }
}

/// The partitions that the mask does not wholly hide, with their numbers.
fn seen_partitions(resolved: &Resolved) -> anyhow::Result<Vec<(u32, View)>> {
    let mask = resolved.mask()?;
    let views = resolved.partition_views.iter().copied();
    Ok((0..).zip(views).filter(|(_, view)| !mask.hides_view(view)).collect())
}

/// How a planned view is cut: right for the distance at which its neighbour is expected (the
/// camera's assumed one if none is), and interpolated as its magnification asks for.
fn cut_of(view: View, planned: &PlannedView, camera: &Camera) -> Cut {
    let distance_m = match planned.has_prediction {
        0 => camera.distance_m(),
        _ => Vector3::from(planned.predicted_camera_from_markers.position).norm(),
    };
    Cut { view, distance_m, interpolation: Interpolation::suited_to(&view, camera) }
}

/// The frame's pixels as the configured camera sees them.
fn sphere_of<'m>(
    camera: Camera,
    header: &FrameHeader,
    pixels: &'m [u8],
) -> anyhow::Result<SphereImage<'m>> {
    let (width, height) = (camera.width(), camera.height());
    let (sent, expected) = (header.projection, projection_of(&camera).code());
    anyhow::ensure!(
        sent == expected,
        "its projection has code {sent}, the configured one {expected}. Cure: set camera.projection \
         to what the source sends"
    );
    anyhow::ensure!(
        (header.width, header.height) == (width, height),
        "it has {}x{} pixels, the configuration says {width}x{height}. Cure: set camera.width and \
         camera.height to what the source sends",
        header.width,
        header.height
    );
    Ok(SphereImage::new(pixels, header.stride as usize, camera)?)
}

fn end(
    frame_ends: &Publisher<FrameEnds>,
    job: &mut Job,
    reason: StopReason,
    generation: u32,
) -> anyhow::Result<()> {
    let (views_issued, views_abandoned) = job.tally();
    job.note_end(reason);
    let end = FrameEnd {
        stamp: job.frame.stamp,
        plan_id: job.plan_id,
        taken_ns: job.taken_ns,
        ended_ns: clock::monotonic_ns(),
        views_issued,
        views_abandoned,
        reason: reason.code(),
        generation,
    };
    Ok(frame_ends.send(end, &[])?)
}

fn now() -> Duration {
    Duration::from_nanos(clock::monotonic_ns().unsigned_abs())
}
