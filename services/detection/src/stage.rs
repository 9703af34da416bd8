//! The ports around detection.

use flockeye_config::Pipeline;
use flockeye_contract::{DetectionHeader, Detections, Views};
use flockeye_runtime::findings::Finding;
use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::logs::Throttle;
use flockeye_runtime::ports::{Message, Ports, Publisher, Subscriber};
use flockeye_runtime::{Context, Stage, Step, clock};

use crate::core::Core;

/// Receives the views of its lane and sends a detection record for each, also for an empty one.
pub(crate) struct DetectionStage {
    views: Subscriber<Views>,
    detections: Publisher<Detections>,
    core: Core,
    counters: SharedCounters,
    failures: Throttle,
}

impl Stage for DetectionStage {
    const NAME: &'static str = "detection";

    fn open(context: &Context, ports: &mut Ports) -> anyhow::Result<Self> {
        let (worker, generation) = (context.identity.replica, context.identity.generation);
        let core = Core::new(&context.resolved, worker, generation)?;
        context.counters.set_detail(core.dictionary());
        Ok(Self {
            views: ports.subscriber_of_lane(worker as usize)?,
            detections: ports.publisher()?,
            core,
            counters: context.counters.clone(),
            failures: Throttle::default(),
        })
    }

    fn examine(pipeline: &Pipeline) -> Vec<Finding> {
        crate::opencv_detector::examine(&pipeline.bodies.dictionary)
    }

    fn step(&mut self) -> anyhow::Result<Step> {
        let Some(message) = self.views.receive()? else { return Ok(Step::Wait) };
        self.answer(&message)?;
        Ok(Step::Again)
    }
}

impl DetectionStage {
    fn answer(&mut self, message: &Message<Views>) -> anyhow::Result<()> {
        let received_ns = clock::monotonic_ns();
        let Some((header, markers)) = self.core.on_view(&message.header, message.items()) else {
            return Ok(());
        };
        let markers = markers.unwrap_or_else(|error| {
            self.counters.add_failed(1);
            if let Some(more) = self.failures.admit() {
                tracing::warn!(more_since = more, "a view cannot be searched: {error:#}");
            }
            Vec::new()
        });
        let sent_ns = clock::monotonic_ns();
        self.counters.add_latency_ns(sent_ns - received_ns);
        let header = DetectionHeader { received_ns, sent_ns, ..header };
        Ok(self.detections.send(header, &markers)?)
    }
}
