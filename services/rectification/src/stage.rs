//! The rectification stage: moves messages between the ports, the core and the back end.

use std::collections::BTreeMap;

use anyhow::{Context as _, Result as Outcome};
use flockeye_config::Pipeline;
use flockeye_contract::{FrameEnds, FrameOrder, Frames, ViewHeader, Views};
use flockeye_imaging::sphere::Cut;
use flockeye_runtime::findings::Finding;
use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::logs::Throttle;
use flockeye_runtime::ports::{Message, Ports, Publisher};
use flockeye_runtime::{Context, Stage, Step, clock};

use crate::backend::{self, choose_backend};
use crate::core::{Action, Core, CutOrder, Event};
use crate::cutting::Cutter;
use crate::inbox::InputPorts;
use crate::proposals::ProposalSearch;
use crate::silence_reports::SilenceReports;

type FrameEvent = Event<Message<Frames>>;

/// Inputs: frames, plans, and detections as acknowledgements. Outputs: views and frame ends.
pub(crate) struct RectificationStage {
    inbox: InputPorts,
    /// Publisher per worker.
    views: Vec<Publisher<Views>>,
    frame_ends: Publisher<FrameEnds>,
    core: Core<Message<Frames>>,
    cutter: Cutter,
    reports: SilenceReports,
    counters: SharedCounters,
    /// Throttle per text: many warnings of one text do not suppress another.
    warnings: BTreeMap<&'static str, Throttle>,
}

impl Stage for RectificationStage {
    const NAME: &'static str = "rectification";

    fn open(context: &Context, ports: &mut Ports) -> anyhow::Result<Self> {
        let (resolved, generation) = (&context.resolved, context.identity.generation);
        let pipeline = &resolved.pipeline;
        let choice = pipeline.rectification.backend;
        let threads = pipeline.rectification.threads as usize;
        let (rectifier, why) = choose_backend(choice, threads, &resolved.camera)?;
        tracing::info!("views are cut by {}: {why}", rectifier.name());
        let lanes = 0..pipeline.detection_workers() as usize;
        Ok(Self {
            inbox: InputPorts::open(ports, pipeline.flow())?,
            views: lanes.map(|lane| ports.publisher_of_lane(lane)).collect::<Result<_, _>>()?,
            frame_ends: ports.publisher()?,
            core: Core::of(resolved, generation, clock::monotonic_ns())?,
            cutter: Cutter::new(rectifier, threads, context.counters.clone(), resolved.camera),
            reports: SilenceReports::new(ports.listening(), pipeline.view_overdue()),
            counters: context.counters.clone(),
            warnings: BTreeMap::new(),
        })
    }

    fn examine(pipeline: &Pipeline) -> Vec<Finding> {
        backend::examine(pipeline.rectification.backend)
    }

    fn step(&mut self) -> anyhow::Result<Step> {
        self.counters.add_dropped(self.inbox.receive(&mut self.core)?);
        self.reports.attend(&mut self.core);
        if let Some((header, frame)) = &self.core.waiting
            && let Err(error) = self.cutter.prepare(header, frame.items())
        {
            tracing::debug!("a frame cannot be prepared: {error:#}"); // a warning follows when work on it begins
        }
        let action = self.core.step(clock::monotonic_ns());
        match &action {
            Action::Wait(_) => {}
            Action::End(end) => self.frame_ends.send(*end, &[])?,
            Action::TakeUp { frame, likely } => {
                let done = self.announce(*frame, likely);
                self.feed(*frame, done, "frame refused");
            }
            Action::Look { frame, search } => {
                let done = self.look(*frame, search).map(Some);
                self.feed(*frame, done, "a view cannot be cut");
            }
            Action::Cut(order) => {
                let done = self.cut(order).map(Some);
                self.feed(order.frame(), done, "a view cannot be cut");
            }
        }
        self.counters.set_queued(self.core.outstanding());
        Ok(match action {
            Action::Wait(until_ns) => until_ns.map_or(Step::Wait, Step::WaitUntil),
            _ => Step::Again,
        })
    }

    fn drain(&mut self) -> anyhow::Result<()> {
        let ends = self.core.shut_down(clock::monotonic_ns());
        Ok(ends.into_iter().try_for_each(|end| self.frame_ends.send(end, &[]))?)
    }
}

impl RectificationStage {
    /// Passes the outcome of an action on a frame to the core. A failed frame's end is published
    /// too, because other stages wait for it.
    fn feed(
        &mut self,
        frame: FrameOrder,
        outcome: Outcome<Option<FrameEvent>>,
        what: &'static str,
    ) {
        let event = outcome.unwrap_or_else(|error| {
            self.counters.add_failed(1);
            if let Some(more) = self.warnings.entry(what).or_default().admit() {
                tracing::warn!(frame = frame.2, more_since = more, "{what}: {error:#}");
            }
            Some(Event::Failed(frame))
        });
        if let Some(event) = event {
            self.core.on(event, clock::monotonic_ns());
        }
    }

    fn announce(&mut self, frame: FrameOrder, cuts: &[Cut]) -> Outcome<Option<FrameEvent>> {
        let (header, frame) = self.core.frame(frame).context("the frame is gone")?;
        self.cutter.announce(header, frame.items(), cuts)?;
        Ok(None)
    }

    fn look(&mut self, frame: FrameOrder, search: &ProposalSearch) -> Outcome<FrameEvent> {
        let begun_ns = clock::monotonic_ns();
        let (header, pixels) = self.core.frame(frame).context("the frame is gone")?;
        let found = self.cutter.look(header, pixels.items(), search)?;
        Ok(Event::Looked { frame, found, took_ns: clock::monotonic_ns() - begun_ns })
    }

    /// Cuts a view directly into shared memory, and publishes it.
    fn cut(&mut self, order: &CutOrder) -> Outcome<FrameEvent> {
        let begun_ns = clock::monotonic_ns();
        let (header, frame) = self.core.frame(order.frame()).context("the frame is gone")?;
        let worker = order.header.worker as usize;
        let publisher = self.views.get(worker).context("there is no such worker")?;
        let mut loan = publisher.loan((order.header.size_px as usize).pow(2))?;
        self.cutter.cut(header, frame.items(), order, loan.items_mut())?;
        let issued_ns = clock::monotonic_ns();
        let header = ViewHeader { issued_ns, ..order.header };
        publisher.send_loan(loan, header)?;
        self.counters.add_latency_ns(issued_ns - header.taken_ns);
        Ok(Event::Published { header, took_ns: issued_ns - begun_ns })
    }
}
