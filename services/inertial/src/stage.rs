//! The inertial stage: moves samples from the line to the port.

use std::time::Duration;

use anyhow::Context as _;
use flockeye_config::InertialSource;
use flockeye_contract::{ImuHeader, ImuSample, Imus, MAX_IMU_SAMPLES, StageState};
use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::logs::Throttle;
use flockeye_runtime::ports::{Ports, Publisher};
use flockeye_runtime::{Context, Stage, Step, clock};

use crate::autopilot::{News, SampleReceiver};
use crate::core::Core;
use crate::line_activity::{LineActivity, LineChange};
use crate::message::MessageKind;

/// Longest wait for the autopilot between two checks of everything else.
const WAIT: Duration = Duration::from_millis(20);

/// Sends the samples of an autopilot's inertial sensor. It receives no messages.
pub(crate) struct InertialStage {
    imus: Publisher<Imus>,
    autopilot: SampleReceiver,
    core: Core,
    source: String,
    generation: u32,
    counters: SharedCounters,
    losses: Throttle,
    line: LineActivity,
}

impl Stage for InertialStage {
    const NAME: &'static str = "inertial";

    fn open(context: &Context, ports: &mut Ports) -> anyhow::Result<Self> {
        let inertial = &context.resolved.pipeline.inertial;
        let source = inertial.parsed_source().map_err(anyhow::Error::msg)?;
        let InertialSource::Mavlink(address) = source else {
            anyhow::bail!("inertial.source: {} needs no stage of its own", inertial.source);
        };
        Ok(Self {
            imus: ports.publisher()?,
            autopilot: SampleReceiver::listen(address).context("a thread that reads")?,
            core: Core::default(),
            source: inertial.source.clone(),
            generation: context.identity.generation,
            counters: context.counters.clone(),
            losses: Throttle::default(),
            line: LineActivity::default(),
        })
    }

    fn step(&mut self) -> anyhow::Result<Step> {
        let mut samples = Vec::new();
        let mut patience = WAIT;
        // The number of messages is bounded, so that health is sent under any load.
        for _ in 0..MAX_IMU_SAMPLES {
            let Some(news) = self.autopilot.next(patience)? else { break };
            patience = Duration::ZERO;
            let epoch = self.core.epoch;
            let sample = self.on_news(news);
            // A message contains samples of one clock only.
            if self.core.epoch != epoch {
                self.send(epoch, &std::mem::take(&mut samples))?;
            }
            samples.extend(sample);
        }
        self.send(self.core.epoch, &samples)?;
        self.watch();
        Ok(Step::Again)
    }
}

impl InertialStage {
    fn on_news(&mut self, news: News) -> Option<ImuSample> {
        match news {
            News::Opened => {
                self.line.open(clock::monotonic_ns());
                self.counters.set_detail(format!("{}: open, no samples yet", self.source));
                None
            }
            News::Lost { reason } => {
                self.line.lose();
                self.counters.set_state(Some(StageState::Degraded));
                self.counters.set_detail(format!("{}: {reason}", self.source));
                if let Some(more) = self.losses.admit() {
                    tracing::warn!(
                        more_since = more,
                        "{}: {reason}; it is opened again. Cure: check the device, the rate and that no other \
                         program has it",
                        self.source
                    );
                }
                None
            }
            News::Sample { sender, sample, arrived_ns } => {
                self.core.on_sample(sender, &sample, arrived_ns)
            }
        }
    }

    fn send(&self, epoch: u32, samples: &[ImuSample]) -> anyhow::Result<()> {
        if samples.is_empty() {
            return Ok(());
        }
        let header =
            ImuHeader { sent_ns: clock::monotonic_ns(), epoch, generation: self.generation };
        Ok(self.imus.send(header, samples)?)
    }

    /// Logs when samples begin, when they stop, and when none arrive.
    fn watch(&mut self) {
        let now_ns = clock::monotonic_ns();
        let source = &self.source;
        let silent = match self.line.check(self.core.newest(now_ns), now_ns) {
            None => return,
            Some(LineChange::Active(kind)) => {
                let message = match kind {
                    MessageKind::HighresImu => "HIGHRES_IMU",
                    MessageKind::AttitudeQuaternion => "ATTITUDE_QUATERNION",
                };
                self.counters.set_state(None);
                self.counters.set_detail(format!("{source}: samples in {message}"));
                tracing::info!("{source}: samples come in {message}");
                return;
            }
            Some(LineChange::Stopped) => "samples have stopped",
            Some(LineChange::Silent) => "no samples come",
        };
        self.counters.set_state(Some(StageState::Degraded));
        self.counters.set_detail(format!("{source}: {silent}"));
        tracing::warn!(
            "{source}: {silent}. Cure: check the autopilot's stream rates for HIGHRES_IMU and \
             ATTITUDE_QUATERNION"
        );
    }
}
