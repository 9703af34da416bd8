//! A detector in place of Flockeye's own, in Rust.
//!
//!     cargo build --release -p my-detector
//!     flockeye swap detection -- target/release/my-detector
//!
//! It searches as Flockeye's own does: `search` is the place for something better.

use std::process::ExitCode;

use flockeye_contract::{DetectedMarker, DetectionHeader, Detections, ViewHeader, Views};
use flockeye_detection::core::Core;
use flockeye_runtime::health::{Identity, SharedCounters};
use flockeye_runtime::ports::{Ports, Publisher, Subscriber};
use flockeye_runtime::{Context, Stage, Step, clock};

/// Answers each view of its lane, also with nothing: without an answer the worker counts as silent.
struct MyDetector {
    identity: Identity,
    counters: SharedCounters,
    views: Subscriber<Views>,
    detections: Publisher<Detections>,
    core: Core,
}

/// The markers of a view, and the number of those that a configured body has.
struct Found {
    markers: Vec<DetectedMarker>,
    hits: u32,
}

impl Stage for MyDetector {
    const NAME: &'static str = "detection";

    fn open(context: &Context, ports: &mut Ports) -> anyhow::Result<Self> {
        let identity = context.identity.clone();
        context.counters.set_detail("my own search");
        Ok(Self {
            views: ports.subscriber_of_lane(identity.replica as usize)?,
            detections: ports.publisher()?,
            core: Core::new(&context.resolved, identity.replica, identity.generation)?,
            counters: context.counters.clone(),
            identity,
        })
    }

    fn step(&mut self) -> anyhow::Result<Step> {
        let Some(view) = self.views.receive()? else { return Ok(Step::Wait) };
        // A view left over from another worker of this lane is not ours to answer.
        if view.header.worker != self.identity.replica {
            return Ok(Step::Again);
        }
        let received_ns = clock::monotonic_ns();
        let found = self.search(&view.header, view.items());
        let failed = u32::from(found.is_err());
        let Found { markers, hits } = found.unwrap_or_else(|error| {
            self.counters.add_failed(1);
            eprintln!("view {}: {error:#}", view.header.view_index);
            Found { markers: Vec::new(), hits: 0 }
        });
        let answer = DetectionHeader {
            received_ns,
            sent_ns: clock::monotonic_ns(),
            generation: self.identity.generation,
            worker: self.identity.replica,
            hits,
            failed,
            ..DetectionHeader::answering(&view.header)
        };
        self.detections.send(answer, &markers)?;
        Ok(Step::Again)
    }
}

impl MyDetector {
    /// The markers in a view. `pixels` are its rows of `stride` bytes, in shared memory, not copied.
    fn search(&mut self, view: &ViewHeader, pixels: &[u8]) -> anyhow::Result<Found> {
        let Some((header, markers)) = self.core.on_view(view, pixels) else {
            return Ok(Found { markers: Vec::new(), hits: 0 });
        };
        Ok(Found { markers: markers?, hits: header.hits })
    }
}

fn main() -> ExitCode {
    flockeye_runtime::stage::main::<MyDetector>()
}
