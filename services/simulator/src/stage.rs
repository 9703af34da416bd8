//! The simulator stage: publishes the frames that the world draws.

use anyhow::Context as _;
use flockeye_config::Flow;
use flockeye_contract::{Frames, Imus, MAX_IMU_SAMPLES, Truths};
use flockeye_runtime::credits::Credits;
use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::ports::{Loan, Ports, Publisher};
use flockeye_runtime::{Context, Stage, Step, clock};

use crate::World;
use crate::ahead::{AheadDrawer, DrawnFrame};
use crate::core::{Action, Core, PictureMessages};
use crate::settings::{in_words, world};

/// Inputs: none, or plans as credits in a lossless run. Outputs: frames and their truth, and
/// inertial samples if configured.
pub(crate) struct SimulatorStage {
    frames: Publisher<Frames>,
    truths: Publisher<Truths>,
    imus: Option<Publisher<Imus>>,
    credits: Credits,
    core: Core,
    drawer: Drawer,
    counters: SharedCounters,
}

enum Drawer {
    /// Drawing in this thread on request, in a lossless run.
    OnDemand(Box<World>),
    Ahead(AheadDrawer),
}

impl Stage for SimulatorStage {
    const NAME: &'static str = "simulator";

    fn open(context: &Context, ports: &mut Ports) -> anyhow::Result<Self> {
        let (resolved, generation) = (&context.resolved, context.identity.generation);
        let pipeline = &resolved.pipeline;
        let (world, flying) = world(resolved, context.saved_states.folder())?;
        context.counters.set_detail(in_words(&pipeline.simulator));
        let core = Core::new(resolved, &world, flying.as_ref(), generation);
        let imus = core.has_sensor().then(|| ports.publisher()).transpose()?;
        let drawer = match pipeline.flow() {
            Flow::Lossless => Drawer::OnDemand(Box::new(world)),
            Flow::Latest => {
                let ahead = AheadDrawer::start(world, core.last_frame);
                Drawer::Ahead(ahead.context("a thread that draws")?)
            }
        };
        Ok(Self {
            frames: ports.publisher()?,
            truths: ports.side_publisher()?,
            imus,
            credits: Credits::open(pipeline, ports)?,
            core,
            drawer,
            counters: context.counters.clone(),
        })
    }

    fn step(&mut self) -> anyhow::Result<Step> {
        if !self.credits.may_send()? {
            return Ok(Step::WaitUntil(Credits::retry_ns()));
        }
        match self.core.step(clock::monotonic_ns()) {
            Action::Draw(frame) => self.draw(frame)?,
            Action::Await => {
                let Drawer::Ahead(ahead) = &mut self.drawer else {
                    anyhow::bail!("a frame is awaited, and none is drawn ahead")
                };
                self.counters.add_dropped(self.core.on(ahead.take()?));
            }
            Action::HandOver(drawn) => self.hand_over(*drawn)?,
            Action::LeaveOut(drawn) => {
                self.counters.add_dropped(1);
                self.reuse(*drawn);
            }
            Action::WaitUntil(at_ns) => return Ok(Step::WaitUntil(at_ns)),
            Action::Finish => return Ok(Step::Finished),
        }
        Ok(Step::Again)
    }
}

impl SimulatorStage {
    /// Draws a frame in shared memory.
    fn draw(&mut self, frame: u64) -> anyhow::Result<()> {
        let Drawer::OnDemand(world) = &mut self.drawer else {
            anyhow::bail!("frames are drawn ahead, and one was asked for")
        };
        let begun_ns = clock::monotonic_ns();
        let (width, height) = self.core.size_px();
        let mut loan = self.frames.loan(width as usize * height as usize)?;
        let truth = world
            .render(frame, loan.items_mut(), width as usize)
            .with_context(|| format!("frame {frame}"))?;
        let now_ns = clock::monotonic_ns();
        self.counters.add_latency_ns(now_ns - begun_ns);
        let messages = self.core.messages(&truth, None, now_ns);
        self.send(loan, &messages)?;
        self.credits.note_sent(messages.frame.stamp);
        Ok(())
    }

    /// Copies a frame that was drawn ahead, and publishes it when it is due.
    fn hand_over(&mut self, drawn: DrawnFrame) -> anyhow::Result<()> {
        let times = drawn.times;
        let mut loan = self.frames.loan(drawn.luma.len())?;
        loan.items_mut().copy_from_slice(&drawn.luma);
        std::thread::sleep(clock::until(times.handover_ns, clock::monotonic_ns()));
        let exposure_ns = Some(times.exposure_ns);
        let messages = self.core.messages(&drawn.truth, exposure_ns, clock::monotonic_ns());
        self.send(loan, &messages)?;
        self.reuse(drawn);
        Ok(())
    }

    /// Counts a frame that was drawn ahead, and returns its memory to the drawing thread.
    fn reuse(&mut self, drawn: DrawnFrame) {
        self.counters.add_dropped(drawn.skipped);
        self.counters.add_latency_ns(drawn.took_ns);
        if let Drawer::Ahead(ahead) = &self.drawer {
            ahead.reuse(drawn.luma);
        }
    }

    /// Sends a frame's messages, the picture last: subscribers have its truth and samples before
    /// it.
    fn send(&self, loan: Loan<Frames>, messages: &PictureMessages) -> anyhow::Result<()> {
        if let (Some(imus), Some((header, samples))) = (&self.imus, &messages.inertial) {
            for samples in samples.chunks(MAX_IMU_SAMPLES) {
                imus.send(*header, samples)?;
            }
        }
        let (header, bodies) = &messages.truth;
        self.truths.send(*header, bodies)?;
        Ok(self.frames.send_loan(loan, messages.frame)?)
    }
}
