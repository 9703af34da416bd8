//! The ports around egomotion.

use flockeye_config::Flow;
use flockeye_contract::{Frames, Imus, Rotations};
use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::logs::Throttle;
use flockeye_runtime::ports::{Ports, Publisher, Subscriber};
use flockeye_runtime::{Context, Stage, Step, clock};
use nalgebra::Vector3;

use crate::core::Core;
use crate::inertial::SensorNotice;
use crate::words::RotationCount;

/// Receives frames and an inertial sensor's samples, and sends the camera's rotation for each
/// frame.
pub(crate) struct EgomotionStage {
    frames: Subscriber<Frames>,
    /// `None` without a sensor.
    imus: Option<Subscriber<Imus>>,
    rotations: Publisher<Rotations>,
    core: Core,
    flow: Flow,
    counters: SharedCounters,
    count: RotationCount,
    refusals: Throttle,
}

impl Stage for EgomotionStage {
    const NAME: &'static str = "egomotion";

    fn open(context: &Context, ports: &mut Ports) -> anyhow::Result<Self> {
        let has_sensor = context.resolved.pipeline.uses_inertial_sensor();
        Ok(Self {
            frames: ports.subscriber()?,
            imus: if has_sensor { Some(ports.subscriber()?) } else { None },
            rotations: ports.publisher()?,
            core: Core::new(&context.resolved, context.identity.generation)?,
            flow: context.resolved.pipeline.flow(),
            counters: context.counters.clone(),
            count: RotationCount::default(),
            refusals: Throttle::default(),
        })
    }

    fn step(&mut self) -> anyhow::Result<Step> {
        let frame = match self.flow {
            Flow::Latest => self.frames.newest()?,
            Flow::Lossless => self.frames.receive()?,
        };
        // Read after the frame: its source sent the samples that cover it before the frame.
        if let Some(imus) = &mut self.imus {
            while let Some(samples) = imus.receive()? {
                self.core.on_samples(&samples.header, samples.items());
            }
        }
        let Some(frame) = frame else { return Ok(Step::Wait) };
        let begun_ns = clock::monotonic_ns();
        match self.core.on_frame(&frame.header, frame.items()) {
            Ok(rotation) => {
                drop(frame);
                self.counters.set_detail(self.count.in_words(&rotation));
                self.rotations.send(rotation, &[])?;
                self.counters.add_latency_ns(clock::monotonic_ns() - begun_ns);
                self.core.take_notices().into_iter().for_each(log);
            }
            Err(error) => {
                self.counters.add_failed(1);
                if let Some(more) = self.refusals.admit() {
                    let frame = frame.header.stamp.sequence;
                    tracing::warn!(frame, more_since = more, "frame refused: {error:#}");
                }
            }
        }
        Ok(Step::Again)
    }
}

/// Logs a notice of the inertial sensor.
fn log(notice: SensorNotice) {
    let degrees = |rate: Vector3<f64>| {
        let [x, y, z] = rate.map(f64::to_degrees).into();
        format!("{x:.1}, {y:.1}, {z:.1} degrees/s about x, y, z")
    };
    match notice {
        SensorNotice::Agrees { bias } => {
            tracing::info!("the inertial sensor agrees with the picture; bias {}", degrees(bias));
        }
        SensorNotice::Disagrees { off } => tracing::warn!(
            "the inertial sensor disagrees with the picture by {} and is left out. Cure: check its axes and \
             its clock with flockeye calibrate imu",
            degrees(off)
        ),
        SensorNotice::Silent => tracing::warn!(
            "no samples of the inertial sensor cover the frames: is it sending, and is \
             inertial.time_offset_ms right?"
        ),
        SensorNotice::Heard => tracing::info!("the inertial sensor sends again"),
    }
}
