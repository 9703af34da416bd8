//! The fusion stage: moves messages between the ports, the core and the background pass.

use std::time::Duration;

use flockeye_config::Flow;
use flockeye_contract::{Journals, Plans, Tracks, Views};
use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::ports::{Message, Ports, Publisher};
use flockeye_runtime::{Context, Stage, Step, clock};

use anyhow::Context as _;

use crate::background_runner::BackgroundRunner;
use crate::core::{Core, Event, Outputs};
use crate::inbox::Inbox;
use crate::journal::Journal;
use crate::notices::Throttles;
use crate::output::Writer;
use crate::settings::configured;
use crate::succession::Succession;

/// Period at which an open frame checks whether its background pass is over, nanoseconds.
const BACKGROUND_POLL_NS: i64 = 4_000_000;

/// Period at which the stage checks whether rectification has joined, nanoseconds.
const JOIN_POLL_NS: i64 = 5_000_000;

/// Receives views, detections and frame ends. Sends tracks and plans, and a journal while it has a
/// reader.
pub(crate) struct FusionStage {
    inbox: Inbox,
    tracks: Publisher<Tracks>,
    plans: Publisher<Plans>,
    journals: Publisher<Journals>,
    core: Core<Message<Views>>,
    writer: Writer,
    background: Option<BackgroundRunner>,
    throttles: Throttles,
    counters: SharedCounters,
    flow: Flow,
    /// Timeout of a lossless run for rectification to join, nanoseconds.
    join_until_ns: i64,
    /// `None` in a lossless run, whose results must not depend on earlier processes.
    succession: Option<Succession>,
}

impl Stage for FusionStage {
    const NAME: &'static str = "fusion";

    fn open(context: &Context, ports: &mut Ports) -> anyhow::Result<Self> {
        let pipeline = &context.resolved.pipeline;
        let (mut core, writer, aligner) =
            configured(&context.resolved, context.identity.generation)?;
        let background = aligner.map(|aligner| match pipeline.flow() {
            Flow::Latest => BackgroundRunner::thread(aligner),
            Flow::Lossless => Ok(BackgroundRunner::inline(aligner)),
        });
        // After a track's longest coasting, nothing of it can be continued.
        let longest = Duration::from_secs_f64(pipeline.fusion.coast_s);
        let succession = (pipeline.flow() == Flow::Latest)
            .then(|| Succession::begin(&mut core, &context.saved_states, longest));
        let has_resumed = succession.as_ref().is_some_and(|before| before.has_resumed);
        let journal = Journal::new(context.identity.generation, has_resumed);
        Ok(Self {
            inbox: Inbox::open(ports, pipeline)?,
            tracks: ports.publisher()?,
            plans: ports.publisher()?,
            journals: ports.side_publisher()?,
            core: core.journaled(journal),
            writer,
            background: background.transpose().context("a thread for the background pass")?,
            throttles: Throttles::new(),
            counters: context.counters.clone(),
            flow: pipeline.flow(),
            join_until_ns: clock::monotonic_ns() + pipeline.frame_deadline().as_nanos() as i64,
            succession,
        })
    }

    fn step(&mut self) -> anyhow::Result<Step> {
        let now_ns = clock::monotonic_ns();
        let is_alone = self.flow == Flow::Lossless && !self.inbox.connect()?;
        if is_alone && self.core.frames.newest_plan == 0 && now_ns < self.join_until_ns {
            return Ok(Step::WaitUntil(now_ns + JOIN_POLL_NS));
        }
        self.plans.update_connections()?;
        if let Some(journal) = self.core.journal() {
            journal.listen(self.journals.readers() > 0);
        }
        self.inbox.receive(&mut self.core, now_ns)?;
        if let Some(runner) = &mut self.background
            && let Some(answer) = runner.answer()?
        {
            self.core.on(Event::Background(answer), now_ns);
        }
        let outputs = self.core.step(clock::monotonic_ns());
        let is_idle = outputs.is_idle;
        self.send(outputs)?;
        self.send_journal(is_idle)?;
        self.counters.set_queued(self.core.frames.count());
        if !is_idle {
            return Ok(Step::Again);
        }
        if self.core.awaits_background() {
            return Ok(Step::WaitUntil(clock::monotonic_ns() + BACKGROUND_POLL_NS));
        }
        let deadlines = [self.core.frames.next_deadline_ns(), self.inbox.next_deadline_ns()];
        Ok(deadlines.into_iter().flatten().min().map_or(Step::Wait, Step::WaitUntil))
    }

    fn drain(&mut self) -> anyhow::Result<()> {
        self.send_journal(true)
    }
}

impl FusionStage {
    fn send_journal(&mut self, is_idle: bool) -> anyhow::Result<()> {
        let mut next = || self.core.journal()?.take(is_idle);
        while let Some((header, entries)) = next() {
            self.journals.send(header, &entries)?;
        }
        Ok(())
    }

    fn send(&mut self, outputs: Outputs) -> anyhow::Result<()> {
        // Saved before it is sent: a successor must not send again what a killed process has sent.
        if let (false, Some(succession)) = (outputs.tracks.is_empty(), &mut self.succession) {
            succession.save(&self.core);
        }
        let sent_ns = clock::monotonic_ns();
        self.core.say(&outputs, sent_ns);
        for message in &outputs.tracks {
            let (header, tracks) = self.writer.tracks(message, self.core.tracker(), sent_ns);
            self.tracks.send(header, &tracks)?;
        }
        if let Some((next, after)) = &outputs.plan {
            let (header, views) = self.writer.plan(next, *after, sent_ns);
            self.plans.send(header, &views).context("the plan for the next frame")?;
            self.counters.set_detail(self.core.tracker().camera().to_string());
        }
        if let (Some(job), Some(runner)) = (outputs.job, &mut self.background) {
            runner.run(job)?;
        }
        if let Some(taken_ns) = outputs.taken_ns {
            self.counters.add_latency_ns(clock::monotonic_ns() - taken_ns);
        }
        for notice in &outputs.notices {
            notice.report(&self.counters, &mut self.throttles);
        }
        Ok(())
    }
}
