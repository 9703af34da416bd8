//! The ports around egomotion.

use flockeye_config::Flow;
use flockeye_contract::{Frames, Rotations};
use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::logs::Throttle;
use flockeye_runtime::ports::{Ports, Publisher, Subscriber};
use flockeye_runtime::{Context, Stage, Step, clock};

use crate::core::Core;

/// Takes frames; gives the camera's rotation to each.
pub struct EgomotionStage {
    frames: Subscriber<Frames>,
    rotations: Publisher<Rotations>,
    core: Core,
    flow: Flow,
    counters: SharedCounters,
    refusals: Throttle,
}

impl Stage for EgomotionStage {
    const NAME: &'static str = "egomotion";

    fn open(context: &Context, ports: &mut Ports) -> anyhow::Result<Self> {
        Ok(Self {
            frames: ports.subscriber()?,
            rotations: ports.publisher()?,
            core: Core::new(&context.resolved, context.identity.generation)?,
            flow: context.resolved.pipeline.flow,
            counters: context.counters.clone(),
            refusals: Throttle::default(),
        })
    }

    fn step(&mut self) -> anyhow::Result<Step> {
        let frame = match self.flow {
            Flow::Latest => self.frames.newest()?,
            Flow::Lossless => self.frames.receive()?,
        };
        let Some(frame) = frame else { return Ok(Step::Wait) };
        let begun_ns = clock::monotonic_ns();
        match self.core.on_frame(&frame.header, frame.items()) {
            Ok(rotation) => {
                drop(frame);
                self.rotations.send(rotation, &[])?;
                self.counters.add_latency_ns(clock::monotonic_ns() - begun_ns);
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
