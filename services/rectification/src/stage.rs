//! The rectification stage: moves messages between the ports, the core and the back end.

use std::rc::Rc;
use std::time::Duration;

use anyhow::Context as _;
use flockeye_config::Pipeline;
use flockeye_contract::{FrameEnds, FrameOrder, Frames, StageName, Views};
use flockeye_runtime::findings::Finding;
use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::listening::Listening;
use flockeye_runtime::logs::Throttle;
use flockeye_runtime::ports::{Message, Ports, Publisher};
use flockeye_runtime::{Context, Stage, Step, clock};

use crate::backend::{self, choose_backend};
use crate::core::{Action, Core, CutOrder, Event};
use crate::cutting::{Cutter, view_header};
use crate::inbox::Inbox;
use crate::proposing::Proposing;
use crate::standby::Standby;

/// A source that sends nothing for this long is reported, nanoseconds.
const SILENCE_NS: i64 = 5_000_000_000;

/// Takes frames, plans and detections (as acknowledgements); gives views and frame ends.
pub struct RectificationStage {
    inbox: Inbox,
    /// One for each worker.
    views: Vec<Publisher<Views>>,
    frame_ends: Publisher<FrameEnds>,
    core: Core<Message<Frames>>,
    cutter: Cutter,
    proposing: Proposing,
    generation: u32,
    listening: Rc<Listening>,
    overdue: Duration,
    counters: SharedCounters,
    failures: Throttle,
    refusals: Throttle,
    silence: Throttle,
}

impl Stage for RectificationStage {
    const NAME: &'static str = "rectification";

    fn open(context: &Context, ports: &mut Ports) -> anyhow::Result<Self> {
        let (resolved, generation) = (&context.resolved, context.identity.generation);
        let pipeline = &resolved.pipeline;
        let choice = pipeline.rectification.backend.into();
        let threads = pipeline.rectification.threads as usize;
        let (rectifier, why) = choose_backend(choice, threads, &resolved.camera)?;
        tracing::info!("views are cut by {}: {why}", rectifier.name());
        let lanes = 0..pipeline.detection_workers() as usize;
        let standby = Standby::new(rectifier, threads, context.counters.clone());
        Ok(Self {
            inbox: Inbox::open(ports, pipeline.flow())?,
            views: lanes.map(|lane| ports.publisher_of_lane(lane)).collect::<Result<_, _>>()?,
            frame_ends: ports.publisher()?,
            core: Core::of(resolved, generation, clock::monotonic_ns())?,
            cutter: Cutter::new(standby, resolved.camera),
            proposing: Proposing::of(resolved)?,
            generation,
            listening: ports.listening(),
            overdue: pipeline.view_overdue(),
            counters: context.counters.clone(),
            failures: Throttle::default(),
            refusals: Throttle::default(),
            silence: Throttle::default(),
        })
    }

    fn examine(pipeline: &Pipeline) -> Vec<Finding> {
        backend::examine(pipeline.rectification.backend.into())
    }

    fn step(&mut self) -> anyhow::Result<Step> {
        self.counters.add_dropped(self.inbox.receive(&mut self.core)?);
        self.report_silence();
        self.report_silent_workers();
        self.prepare();
        let action = self.core.step(clock::monotonic_ns());
        match action {
            Action::TakeUp(frame) => self.take_up(frame),
            Action::Cut(order) => self.cut(order),
            Action::End(end) => self.frame_ends.send(end, &[])?,
            Action::Wait(_) => {}
        }
        self.counters.set_queued(self.core.outstanding());
        Ok(match action {
            Action::Wait(until_ns) => until_ns.map_or(Step::Wait, Step::WaitUntil),
            _ => Step::Again,
        })
    }

    fn drain(&mut self) -> anyhow::Result<()> {
        for end in self.core.shut_down(clock::monotonic_ns()) {
            self.frame_ends.send(end, &[])?;
        }
        Ok(())
    }
}

impl RectificationStage {
    fn report_silence(&mut self) {
        let silence_ns = self.core.silence_ns(clock::monotonic_ns());
        if silence_ns > SILENCE_NS && self.silence.admit().is_some() {
            let s = silence_ns / 1_000_000_000;
            tracing::warn!("no frame has come for {s} s: the source is away, or at its end");
        }
    }

    /// Tells the launcher, which knows the worker's process and replaces it.
    fn report_silent_workers(&mut self) {
        for (worker, count) in self.core.silent_workers() {
            let listening = &self.listening;
            let overdue_ms = self.overdue.as_millis();
            let detail = format!("no view answered for {overdue_ms} ms");
            listening.complain_of_silence(StageName::Detection, worker as u32, count, &detail);
        }
    }

    fn prepare(&mut self) {
        if let Some((header, frame)) = self.core.waiting()
            && let Err(error) = self.cutter.prepare(header, frame.items())
        {
            tracing::debug!("a frame cannot be prepared: {error:#}"); // warned of when taken up
        }
    }

    fn take_up(&mut self, frame: FrameOrder) {
        let Some(held) = self.core.held_mut(frame) else { return };
        let likely = std::mem::take(&mut held.likely);
        if let Err(error) = self.cutter.order(held, Message::items, &likely) {
            // Its end is published all the same: others wait for it.
            self.core.on(Event::Refused(frame), clock::monotonic_ns());
            self.counters.add_failed(1);
            if let Some(more) = self.refusals.admit() {
                tracing::warn!(frame = frame.2, more_since = more, "frame refused: {error:#}");
            }
        }
    }

    fn cut(&mut self, order: CutOrder) {
        let placed = self.place_proposals(order);
        let begun_ns = clock::monotonic_ns();
        let event = match placed.and_then(|()| self.publish(order)) {
            Ok(issued_ns) => Event::Published { order, took_ns: issued_ns - begun_ns },
            Err(error) => {
                self.counters.add_failed(1);
                if let Some(more) = self.failures.admit() {
                    tracing::warn!(more_since = more, "a view cannot be cut: {error:#}");
                }
                Event::CutFailed(order)
            }
        };
        self.core.on(event, clock::monotonic_ns());
    }

    /// Finds the places of a frame's proposals once the first of them is due: tracked neighbours' views are
    /// cut before, and no pose waits for it.
    fn place_proposals(&mut self, order: CutOrder) -> anyhow::Result<()> {
        let held = self.core.held_mut(order.frame).context("the frame is not held")?;
        if held.job.awaits_places() && held.job.proposal(order.view_index).is_some() {
            let begun_ns = clock::monotonic_ns();
            self.cutter.propose(held, Message::items, &mut self.proposing)?;
            let now_ns = clock::monotonic_ns();
            let proposals = held.job.proposal_indices();
            self.cutter.order(held, Message::items, &proposals)?;
            self.core.on(Event::Looked { took_ns: now_ns - begun_ns }, now_ns);
        }
        Ok(())
    }

    /// Cuts a view straight into shared memory, publishes it, and says when.
    fn publish(&mut self, order: CutOrder) -> anyhow::Result<i64> {
        let held = self.core.held_mut(order.frame).context("the frame is not held")?;
        let (view, _) = held.job.view(order.view_index).context("it is not in the plan")?;
        let publisher = self.views.get(order.worker).context("there is no such worker")?;
        let mut loan = publisher.loan((view.size_px as usize).pow(2))?;
        self.cutter.cut(held, Message::items, order, loan.items_mut())?;
        if let Some(place) = held.job.proposal(order.view_index) {
            self.proposing.note_cut(place);
        }
        let issued_ns = clock::monotonic_ns();
        let header = view_header(&held.job, order, self.generation, issued_ns);
        loan.send(header.context("it is not in the plan")?)?;
        self.counters.add_latency_ns(issued_ns - held.job.taken_ns);
        Ok(issued_ns)
    }
}
