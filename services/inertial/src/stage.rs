//! The port behind the autopilot.

use std::time::Duration;

use anyhow::Context as _;
use flockeye_config::InertialSource;
use flockeye_contract::{ImuHeader, ImuSample, Imus, MAX_IMU_SAMPLES, StageState};
use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::logs::Throttle;
use flockeye_runtime::ports::{Ports, Publisher};
use flockeye_runtime::{Context, Stage, Step, clock};

use crate::autopilot::{Autopilot, News};
use crate::core::Core;
use crate::message::MessageKind;

/// How long the autopilot is waited for between two looks at everything else.
const WAIT: Duration = Duration::from_millis(20);

/// Takes nothing; gives the samples of an autopilot's inertial sensor.
pub struct InertialStage {
    imus: Publisher<Imus>,
    autopilot: Autopilot,
    core: Core,
    source: String,
    generation: u32,
    counters: SharedCounters,
    losses: Throttle,
    line: Line,
}

/// What is known of the line to the autopilot.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Line {
    /// It is not there.
    Lost,
    /// It is open, and nothing comes since then, CLOCK_MONOTONIC, nanoseconds.
    Silent { since_ns: i64, is_said: bool },
    /// Samples come.
    Heard(MessageKind),
}

/// A line that is silent for so long after it was opened is said to be, nanoseconds: longer than an autopilot needs
/// to answer.
const SILENT_NS: i64 = 3_000_000_000;

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
            autopilot: Autopilot::listen(address).context("a thread that reads")?,
            core: Core::default(),
            source: inertial.source.clone(),
            generation: context.identity.generation,
            counters: context.counters.clone(),
            losses: Throttle::default(),
            line: Line::Lost,
        })
    }

    fn step(&mut self) -> anyhow::Result<Step> {
        let mut samples = Vec::new();
        let mut patience = WAIT;
        // Not without end: health must be sent however much comes.
        for _ in 0..MAX_IMU_SAMPLES {
            let Some(news) = self.autopilot.next(patience)? else { break };
            patience = Duration::ZERO;
            let epoch = self.core.epoch();
            let sample = self.on_news(news);
            // A message holds samples of one clock.
            if self.core.epoch() != epoch {
                self.send(epoch, &std::mem::take(&mut samples))?;
            }
            samples.extend(sample);
        }
        self.send(self.core.epoch(), &samples)?;
        self.watch();
        Ok(Step::Again)
    }
}

impl InertialStage {
    fn on_news(&mut self, news: News) -> Option<ImuSample> {
        match news {
            News::Opened => {
                self.line = Line::Silent { since_ns: clock::monotonic_ns(), is_said: false };
                self.counters.set_detail(format!("{}: open, no samples yet", self.source));
                None
            }
            News::Lost { reason } => {
                self.line = Line::Lost;
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

    /// Says when samples begin, when they stop, and when none come.
    fn watch(&mut self) {
        let now_ns = clock::monotonic_ns();
        let source = &self.source;
        let silent = match (self.line, self.core.heard(now_ns)) {
            (Line::Silent { .. }, Some(kind)) => {
                let message = match kind {
                    MessageKind::HighresImu => "HIGHRES_IMU",
                    MessageKind::AttitudeQuaternion => "ATTITUDE_QUATERNION",
                };
                self.line = Line::Heard(kind);
                self.counters.set_state(None);
                self.counters.set_detail(format!("{source}: samples in {message}"));
                tracing::info!("{source}: samples come in {message}");
                return;
            }
            (Line::Heard(_), None) => "samples have stopped",
            (Line::Silent { since_ns, is_said: false }, None) if now_ns - since_ns > SILENT_NS => {
                "no samples come"
            }
            _ => return,
        };
        self.line = Line::Silent { since_ns: now_ns, is_said: true };
        self.counters.set_state(Some(StageState::Degraded));
        self.counters.set_detail(format!("{source}: {silent}"));
        tracing::warn!(
            "{source}: {silent}. Cure: check the autopilot's stream rates for HIGHRES_IMU and \
             ATTITUDE_QUATERNION"
        );
    }
}
