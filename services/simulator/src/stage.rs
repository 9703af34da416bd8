//! The simulator stage: moves what the world draws to the ports.

use anyhow::Context as _;
use flockeye_config::{Flow, InertialSource};
use flockeye_contract::{FrameStamp, Frames, ImuHeader, Imus, MAX_IMU_SAMPLES, Truths};
use flockeye_dictionary::Dictionary;
use flockeye_runtime::credits::Credits;
use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::ports::{Ports, Publisher};
use flockeye_runtime::{Context, Stage, Step, clock};

use crate::ahead::{Ahead, Drawn, Next};
use crate::inertial::InertialSensor;
use crate::messages::TruthWriter;
use crate::settings::{flying_bodies, in_words, parameters};
use crate::{FrameTruth, World, WorldParameters};

/// Takes nothing (in a lossless run: plans, as credits); gives frames and their truth, and samples of an
/// inertial sensor if they are asked for.
pub struct SimulatorStage {
    frames: Publisher<Frames>,
    truths: Publisher<Truths>,
    inertial: Option<Inertial>,
    credits: Credits,
    drawing: Drawing,
    writer: TruthWriter,
    counters: SharedCounters,
}

/// Who draws.
enum Drawing {
    /// The stage, when it is asked for a frame: a lossless run.
    OnDemand { world: Box<World>, next_frame: u64, last_frame: u64 },
    /// A thread, and what waits for its time to come.
    Ahead { ahead: Ahead, waiting: Option<Box<Drawn>> },
}

/// The inertial sensor, and its port.
struct Inertial {
    sensor: InertialSensor,
    imus: Publisher<Imus>,
    generation: u32,
    has_joined: bool,
}

impl Inertial {
    /// Sends what the sensor has measured when the exposure ends and the picture is there: before the frame,
    /// so that egomotion has it first.
    fn send(&mut self, stamp: FrameStamp, truth: &FrameTruth) -> anyhow::Result<()> {
        let zero_ns = stamp.exposure_ns - stamp.stream_ns;
        if !std::mem::replace(&mut self.has_joined, true) {
            self.sensor.join(truth.time_s);
        }
        let samples = self.sensor.until(truth.time_s + truth.exposure_s / 2.0, zero_ns);
        let header =
            ImuHeader { sent_ns: clock::monotonic_ns(), epoch: 0, generation: self.generation };
        for samples in samples.chunks(MAX_IMU_SAMPLES) {
            self.imus.send(header, samples)?;
        }
        Ok(())
    }
}

/// So long before its time a frame is brought into shared memory, nanoseconds: several times as long as
/// that takes.
const HANDOVER_NS: i64 = 10_000_000;

impl Stage for SimulatorStage {
    const NAME: &'static str = "simulator";

    fn open(context: &Context, ports: &mut Ports) -> anyhow::Result<Self> {
        let resolved = &context.resolved;
        let pipeline = &resolved.pipeline;
        let flying = flying_bodies(resolved)?;
        let paint_folder = Some(context.saved_states.folder().to_owned());
        let parameters = WorldParameters { paint_folder, ..parameters(resolved)? };
        let world = match &flying {
            Some(bodies) => World::new(parameters, bodies, &Dictionary::of(bodies)?)?,
            None => World::empty(parameters)?,
        };
        context.counters.set_detail(in_words(&pipeline.simulator));
        let inertial = match pipeline.inertial.parsed_source() {
            Ok(InertialSource::Simulated) => {
                let settings = &pipeline.simulator.inertial;
                let seed = world.parameters().seed;
                let sensor = InertialSensor::new(world.motion().clone(), settings, seed);
                let generation = context.identity.generation;
                let imus = ports.publisher()?;
                Some(Inertial { sensor, imus, generation, has_joined: false })
            }
            _ => None,
        };
        let last_frame = pipeline.simulator.frames.checked_sub(1).unwrap_or(u64::MAX);
        let drawing = match pipeline.flow() {
            Flow::Lossless => {
                Drawing::OnDemand { world: Box::new(world), next_frame: 0, last_frame }
            }
            Flow::Latest => {
                let ahead = Ahead::start(world, last_frame).context("a thread that draws")?;
                Drawing::Ahead { ahead, waiting: None }
            }
        };
        Ok(Self {
            frames: ports.publisher()?,
            truths: ports.side_publisher()?,
            inertial,
            credits: Credits::open(pipeline, ports)?,
            drawing,
            writer: TruthWriter::new(resolved, flying.as_ref(), context.identity.generation),
            counters: context.counters.clone(),
        })
    }

    fn step(&mut self) -> anyhow::Result<Step> {
        if !self.credits.may_send()? {
            return Ok(Step::WaitUntil(clock::monotonic_ns() + 100_000_000));
        }
        match &mut self.drawing {
            Drawing::OnDemand { world, next_frame, last_frame } => {
                let frame = *next_frame;
                if frame > *last_frame {
                    return Ok(Step::Finished);
                }
                *next_frame = frame + 1;
                let begun_ns = clock::monotonic_ns();
                let (width, height) = self.writer.size_px();
                let mut loan = self.frames.loan(width as usize * height as usize)?;
                let truth = world
                    .render(frame, loan.items_mut(), width as usize)
                    .with_context(|| format!("frame {frame}"))?;
                self.counters.add_latency_ns(clock::monotonic_ns() - begun_ns);
                let exposure_ns = (truth.time_s * 1e9).round() as i64;
                let stamp = self.writer.stamp(frame, exposure_ns, &truth, clock::monotonic_ns());
                if let Some(inertial) = &mut self.inertial {
                    inertial.send(stamp, &truth)?;
                }
                self.send_truth(stamp, &truth)?;
                loan.send(self.writer.frame(stamp, &truth))?;
                self.credits.note_sent(stamp);
                Ok(Step::Again)
            }
            Drawing::Ahead { ahead, waiting } => {
                let drawn = match waiting.take() {
                    Some(drawn) => drawn,
                    None => match ahead.take()? {
                        Next::Frame(drawn) => drawn,
                        Next::NotYet => return Ok(Step::Again),
                        Next::Over { skipped } => {
                            self.counters.add_dropped(skipped);
                            return Ok(Step::Finished);
                        }
                    },
                };
                let early_ns = drawn.times.handover_ns.saturating_sub(HANDOVER_NS);
                if clock::monotonic_ns() < early_ns {
                    *waiting = Some(drawn);
                    return Ok(Step::WaitUntil(early_ns));
                }
                self.hand_over(*drawn)?;
                Ok(Step::Again)
            }
        }
    }
}

impl SimulatorStage {
    /// Hands a frame over when its time has come, unless the next one's has.
    fn hand_over(&mut self, drawn: Drawn) -> anyhow::Result<()> {
        let Drawn { frame, luma, truth, times, skipped, took_ns } = drawn;
        self.counters.add_dropped(skipped);
        self.counters.add_latency_ns(took_ns);
        let is_too_late = times.next_ns <= clock::monotonic_ns();
        if is_too_late {
            self.counters.add_dropped(1);
        } else {
            let mut loan = self.frames.loan(luma.len())?;
            loan.items_mut().copy_from_slice(&luma);
            std::thread::sleep(clock::until(times.handover_ns, clock::monotonic_ns()));
            let stamp = self.writer.stamp(frame, times.exposure_ns, &truth, clock::monotonic_ns());
            if let Some(inertial) = &mut self.inertial {
                inertial.send(stamp, &truth)?;
            }
            self.send_truth(stamp, &truth)?;
            loan.send(self.writer.frame(stamp, &truth))?;
        }
        if let Drawing::Ahead { ahead, .. } = &self.drawing {
            ahead.reuse(luma);
        }
        Ok(())
    }

    /// Before the frame, so that whoever has a track of it has the truth too.
    fn send_truth(&self, stamp: FrameStamp, truth: &FrameTruth) -> anyhow::Result<()> {
        let (header, bodies) = self.writer.truth(stamp, truth);
        Ok(self.truths.send(header, &bodies)?)
    }
}
