//! The ports around the simulated world.

use anyhow::Context as _;
use flockeye_config::isometry;
use flockeye_config::{Flow, Pipeline};
use flockeye_contract::{
    BodyTruth, FrameHeader, FrameStamp, Frames, PixelFormat, Projection, Range, Transfer,
    TruthHeader, Truths,
};
use flockeye_convert::{pose, projection_of, transfer_curve};
use flockeye_dictionary::Dictionary;
use flockeye_geometry::body::{Bodies, Body};
use flockeye_runtime::credits::Credits;
use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::ports::{Ports, Publisher};
use flockeye_runtime::{Context, Stage, Step, clock};
use nalgebra::Isometry3;

use crate::ahead::{Ahead, Drawn, Next};
use crate::{FrameTruth, Response, TargetTruth, World, WorldParameters};

/// Takes nothing (in a lossless run: plans, as credits); gives frames and their truth.
pub struct SimulatorStage {
    frames: Publisher<Frames>,
    truths: Publisher<Truths>,
    credits: Credits,
    drawing: Drawing,
    /// Width and height of a frame.
    size_px: (u32, u32),
    projection: Projection,
    /// Its code and its gamma.
    transfer: (Transfer, f32),
    bodies: Vec<Body>,
    observer_from_camera: Isometry3<f64>,
    generation: u32,
    counters: SharedCounters,
}

/// Who draws.
enum Drawing {
    /// The stage, when it is asked for a frame: a lossless run.
    OnDemand { world: Box<World>, next_frame: u64, last_frame: u64 },
    /// A thread, and what waits for its time to come.
    Ahead { ahead: Ahead, waiting: Option<Box<Drawn>> },
}

/// So long before its time a frame is brought into shared memory, nanoseconds: several times as long as
/// that takes.
const HANDOVER_NS: i64 = 10_000_000;

impl Stage for SimulatorStage {
    const NAME: &'static str = "simulator";

    fn open(context: &Context, ports: &mut Ports) -> anyhow::Result<Self> {
        let pipeline = &context.pipeline;
        let flying = flying_bodies(pipeline)?;
        let parameters = parameters(pipeline)?;
        let world = match &flying {
            Some(bodies) => World::new(parameters, bodies, &Dictionary::of(bodies)?)?,
            None => World::empty(parameters)?,
        };
        context.counters.set_detail(format!(
            "{} neighbours, {} frames/s, seed {}",
            pipeline.simulator.neighbours,
            pipeline.simulator.frames_per_second,
            pipeline.simulator.seed
        ));
        let camera = pipeline.camera_model()?;
        let last_frame = pipeline.simulator.frames.checked_sub(1).unwrap_or(u64::MAX);
        let drawing = match pipeline.flow {
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
            credits: Credits::open(pipeline, ports)?,
            drawing,
            size_px: (camera.width(), camera.height()),
            projection: projection_of(&camera),
            transfer: pipeline.transfer(),
            bodies: flying.iter().flat_map(Bodies::iter).cloned().collect(),
            observer_from_camera: isometry(&pipeline.observer.observer_from_camera),
            generation: context.identity.generation,
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
                let (width, height) = self.size_px;
                let mut loan = self.frames.loan(width as usize * height as usize)?;
                let truth = world
                    .render(frame, loan.items_mut(), width as usize)
                    .with_context(|| format!("frame {frame}"))?;
                self.counters.add_latency_ns(clock::monotonic_ns() - begun_ns);
                let exposure_ns = (truth.time_s * 1e9).round() as i64;
                let stamp = self.stamp(frame, exposure_ns, &truth);
                self.send_truth(stamp, &truth)?;
                loan.send(self.header(stamp, &truth))?;
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
            let stamp = self.stamp(frame, times.exposure_ns, &truth);
            self.send_truth(stamp, &truth)?;
            loan.send(self.header(stamp, &truth))?;
        }
        if let Drawing::Ahead { ahead, .. } = &self.drawing {
            ahead.reuse(luma);
        }
        Ok(())
    }

    fn stamp(&self, frame: u64, exposure_ns: i64, truth: &FrameTruth) -> FrameStamp {
        FrameStamp {
            sequence: frame,
            exposure_ns,
            stream_ns: (truth.time_s * 1e9).round() as i64,
            published_ns: clock::monotonic_ns(),
            epoch: 0,
            source_generation: self.generation,
        }
    }

    fn header(&self, stamp: FrameStamp, truth: &FrameTruth) -> FrameHeader {
        let (width, height) = self.size_px;
        FrameHeader {
            stamp,
            exposure_time_ns: (truth.exposure_s * 1e9).round() as u64,
            readout_ns: 0,
            width,
            height,
            stride: width,
            pixel_format: PixelFormat::Gray8.code(),
            transfer: self.transfer.0.code(),
            gamma: self.transfer.1,
            range: Range::Full.code(),
            projection: self.projection.code(),
        }
    }

    /// Before the frame, so that whoever has a track of it has the truth too.
    fn send_truth(&self, stamp: FrameStamp, truth: &FrameTruth) -> anyhow::Result<()> {
        let targets = truth.bodies.iter().zip(&self.bodies);
        let bodies: Vec<BodyTruth> =
            targets.map(|(target, body)| self.body_truth(target, body)).collect();
        Ok(self.truths.send(truth_header(stamp, truth), &bodies)?)
    }

    fn body_truth(&self, target: &TargetTruth, body: &Body) -> BodyTruth {
        let camera_from_target = target.camera_from_markers * body.target_from_markers.inverse();
        BodyTruth {
            camera_from_markers: pose(&target.camera_from_markers),
            observer_from_target: pose(&(self.observer_from_camera * camera_from_target)),
            best_side_px: target.best_side_px,
            blur_px: target.blur_px,
            name: target.name.as_str().into(),
            target: target.target as u32,
            markers_visible_50: target.markers_visible_50,
            markers_visible_90: target.markers_visible_90,
            localisable: u32::from(target.localisable),
        }
    }
}

fn truth_header(stamp: FrameStamp, truth: &FrameTruth) -> TruthHeader {
    TruthHeader { stamp, observer_yaw: truth.observer_yaw, exposure_s: truth.exposure_s }
}

/// The bodies that fly: the first of those configured.
fn flying_bodies(pipeline: &Pipeline) -> anyhow::Result<Option<Bodies>> {
    let all = pipeline.simulated_bodies()?;
    let count = pipeline.simulator.neighbours as usize;
    anyhow::ensure!(
        count <= all.len(),
        "simulator.neighbours: {count} neighbours, but {} bodies are configured",
        all.len()
    );
    if count == 0 {
        return Ok(None);
    }
    let bodies = all.iter().take(count).cloned().collect();
    Ok(Some(Bodies::new(all.dictionary.clone(), bodies)?))
}

fn parameters(pipeline: &Pipeline) -> anyhow::Result<WorldParameters> {
    let (settings, usual) = (&pipeline.simulator, WorldParameters::default());
    let (transfer, gamma) = pipeline.transfer();
    let response = match transfer_curve(transfer, gamma) {
        Some(curve) => Response::Curve(curve),
        None => Response::Table(pipeline.response_table()?),
    };
    Ok(WorldParameters {
        seed: u64::from(settings.seed),
        camera: pipeline.camera_model()?,
        response,
        frames_per_second: settings.frames_per_second,
        exposure_s: settings.exposure_ms * 1e-3,
        read_noise: usual.read_noise * settings.noise,
        shot_noise: usual.shot_noise * settings.noise,
        lens_blur_px: settings.lens_blur_px,
        observer_yaw_rate_deg_s: settings.yaw_deg_s,
        distance_m: settings.distance_m,
        airframes: settings.airframes,
        ..usual
    })
}
