//! Input ports of rectification, and the order in which they are read.

use flockeye_config::Flow;
use flockeye_contract::{Detections, Frames, Plans};
use flockeye_runtime::clock;
use flockeye_runtime::ports::{Message, PortError, Ports, Subscriber};

use crate::core::{Core, Event};

pub(crate) struct InputPorts {
    frames: Subscriber<Frames>,
    plans: Subscriber<Plans>,
    detections: Subscriber<Detections>,
    flow: Flow,
}

impl InputPorts {
    pub(crate) fn open(ports: &mut Ports, flow: Flow) -> Result<Self, PortError> {
        Ok(Self {
            frames: ports.subscriber()?,
            plans: ports.subscriber()?,
            detections: ports.subscriber()?,
            flow,
        })
    }

    /// Passes all received messages to the core. Returns the number of dropped frames. Frames are
    /// read first: in a lossless run the source sends a frame after its plan.
    pub(crate) fn receive(&mut self, core: &mut Core<Message<Frames>>) -> Result<u64, PortError> {
        let mut dropped = 0;
        while (self.flow == Flow::Latest || core.waiting.is_none())
            && let Some(frame) = self.frames.receive()?
        {
            let is_dropped = core.on(Event::Frame(frame.header, frame), clock::monotonic_ns());
            dropped += u64::from(is_dropped);
        }
        if let Some(plan) = self.plans.newest()? {
            core.on(Event::Plan(plan.header, plan.items().to_vec()), clock::monotonic_ns());
        }
        while let Some(record) = self.detections.receive()? {
            core.on(Event::Answer(record.header), clock::monotonic_ns());
        }
        Ok(dropped)
    }
}
