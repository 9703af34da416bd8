//! The ports around the simulated world.

use anyhow::Context as _;
use flockeye_contract::{
    BodyTruth, FrameHeader, FrameStamp, Frames, PixelFormat, Pose, Projection, Range, Transfer,
    TruthHeader, Truths,
};
use flockeye_dictionary::Dictionary;
use flockeye_geometry::body::{Bodies, Body};
use flockeye_imaging::light::TransferCurve;
use flockeye_runtime::bodies::isometry;
use flockeye_runtime::camera::projection_of;
use flockeye_runtime::config::{Flow, Pipeline};
use flockeye_runtime::credits::Credits;
use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::ports::{Ports, Publisher};
use flockeye_runtime::{Context, Stage, Step, clock};
use nalgebra::Isometry3;

use crate::schedule::{Schedule, Times};
use crate::{FrameTruth, Response, TargetTruth, World, WorldParameters};

/// Takes nothing (in a lossless run: plans, as credits); gives frames and their truth.
pub struct SimulatorStage {
    frames: Publisher<Frames>,
    truths: Publisher<Truths>,
    credits: Credits,
    world: World,
    projection: Projection,
    /// Its code and its gamma.
    transfer: (Transfer, f32),
    bodies: Vec<Body>,
    observer_from_camera: Isometry3<f64>,
    schedule: Option<Schedule>,
    frames_per_second: f64,
    flow: Flow,
    next_frame: u64,
    last_frame: u64,
    generation: u32,
    counters: SharedCounters,
}

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
        Ok(Self {
            frames: ports.publisher()?,
            truths: ports.side_publisher()?,
            credits: Credits::open(pipeline, ports)?,
            world,
            projection: projection_of(&pipeline.camera_model()?),
            transfer: pipeline.transfer(),
            bodies: flying.iter().flat_map(Bodies::iter).cloned().collect(),
            observer_from_camera: isometry(&pipeline.observer.observer_from_camera),
            schedule: None,
            frames_per_second: pipeline.simulator.frames_per_second,
            flow: pipeline.flow,
            next_frame: 0,
            last_frame: match pipeline.simulator.frames {
                0 => u64::MAX,
                frames => frames - 1,
            },
            generation: context.identity.generation,
            counters: context.counters.clone(),
        })
    }

    fn step(&mut self) -> anyhow::Result<Step> {
        if !self.credits.may_send()? {
            return Ok(Step::WaitUntil(clock::monotonic_ns() + 100_000_000));
        }
        if self.next_frame > self.last_frame {
            return Ok(Step::Finished);
        }
        match self.flow {
            Flow::Lossless => {
                let frame = self.next_frame;
                let stream_ns = (self.world.time_of(frame) * 1e9).round() as i64;
                self.send(frame, |drawn_ns| Times {
                    exposure_ns: stream_ns,
                    handover_ns: drawn_ns,
                })?;
                Ok(Step::Again)
            }
            Flow::Latest => {
                let Some(mut schedule) = self.schedule else {
                    return self.begin();
                };
                if let Some(due) = schedule.due(clock::monotonic_ns()) {
                    self.counters.add_dropped(due.skipped);
                    if due.frame <= self.last_frame {
                        schedule.drew(self.send(due.frame, |_| schedule.times(due.frame))?);
                    }
                    self.next_frame = due.frame + 1;
                    self.schedule = Some(schedule);
                }
                Ok(Step::WaitUntil(schedule.next_ns()))
            }
        }
    }
}

impl SimulatorStage {
    /// Draws the first frame, which takes longer than any other. The others follow from when it is there.
    fn begin(&mut self) -> anyhow::Result<Step> {
        let half_exposure_ns = (self.world.parameters().exposure_s * 0.5e9).round() as i64;
        let mut start_ns = 0;
        let took_ns = self.send(0, |drawn_ns| {
            start_ns = drawn_ns - half_exposure_ns;
            Times { exposure_ns: start_ns, handover_ns: drawn_ns }
        })?;
        let mut schedule = Schedule::new(start_ns, self.frames_per_second, half_exposure_ns);
        schedule.drew(took_ns);
        self.schedule = Some(schedule);
        Ok(Step::WaitUntil(schedule.next_ns()))
    }

    /// Draws a frame and hands it over, at the `times` that it is asked for once it is drawn; returns how
    /// long drawing took.
    fn send(&mut self, frame: u64, times: impl FnOnce(i64) -> Times) -> anyhow::Result<i64> {
        let begun_ns = clock::monotonic_ns();
        let camera = self.world.parameters().camera;
        let (width, height) = (camera.width(), camera.height());
        let mut loan = self.frames.loan(width as usize * height as usize)?;
        let truth = self
            .world
            .render(frame, loan.items_mut(), width as usize)
            .with_context(|| format!("frame {frame}"))?;
        let drawn_ns = clock::monotonic_ns();
        let Times { exposure_ns, handover_ns } = times(drawn_ns);
        // It waits in the shared memory that it was drawn in.
        std::thread::sleep(clock::until(handover_ns, drawn_ns));
        let published_ns = clock::monotonic_ns();
        let stamp = FrameStamp {
            sequence: frame,
            exposure_ns,
            stream_ns: (truth.time_s * 1e9).round() as i64,
            published_ns,
            epoch: 0,
            source_generation: self.generation,
        };
        // Before the frame, so that whoever has a track of it has the truth too.
        let bodies: Vec<BodyTruth> = truth
            .bodies
            .iter()
            .zip(&self.bodies)
            .map(|(target, body)| self.body_truth(target, body))
            .collect();
        self.truths.send(truth_header(stamp, &truth), &bodies)?;
        loan.send(FrameHeader {
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
        })?;
        self.counters.add_latency_ns(drawn_ns - begun_ns);
        self.credits.note_sent(stamp);
        self.next_frame = frame + 1;
        Ok(drawn_ns - begun_ns)
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

fn pose(isometry: &Isometry3<f64>) -> Pose {
    Pose {
        position: isometry.translation.vector.into(),
        orientation: isometry.rotation.coords.into(),
    }
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
    let response = match pipeline.transfer() {
        (Transfer::Srgb, _) => Response::Curve(TransferCurve::Srgb),
        (Transfer::Gamma, gamma) => Response::Curve(TransferCurve::Gamma(gamma)),
        (Transfer::Linear, _) => Response::Curve(TransferCurve::Linear),
        (Transfer::Table, _) => Response::Table(pipeline.response_table()?),
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
