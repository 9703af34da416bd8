//! The ports around the core, and the link.

use flockeye_contract::wire::FrameReport;
use flockeye_contract::{
    Odometries, PeerHeader, Peers, Rotations, StageState, SwarmHeader, Swarms, Tracks,
};
use flockeye_network::{ClockReading, NetworkParameters};
use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::ports::{Ports, Publisher, Subscriber};
use flockeye_runtime::{Context, Stage, Step, clock};

use crate::core::Core;
use crate::link::SwarmLink;

/// Period at which a network that failed is opened again, nanoseconds.
const RETRY_NS: i64 = 5_000_000_000;
/// Period of the text on the peers' state, nanoseconds.
const DETAIL_NS: i64 = 500_000_000;
/// Period of the check for reports of peers, nanoseconds.
const LISTEN_NS: i64 = 10_000_000;
/// Period of the swarm's poses, nanoseconds.
const SWARM_NS: i64 = 100_000_000;
/// Pause relative to the computing time of the swarm's poses, which then take at most about a tenth
/// of the time.
const SWARM_PAUSE: i64 = 10;

/// Sends tracks as reports to the swarm, and publishes the peers' reports to the pipeline.
pub(crate) struct GatewayStage {
    tracks: Subscriber<Tracks>,
    rotations: Subscriber<Rotations>,
    odometries: Subscriber<Odometries>,
    peers: Publisher<Peers>,
    swarms: Publisher<Swarms>,
    parameters: NetworkParameters,
    link: Option<SwarmLink>,
    core: Core,
    generation: u32,
    retry_ns: i64,
    detail_ns: i64,
    swarm_ns: i64,
    counters: SharedCounters,
}

impl Stage for GatewayStage {
    const NAME: &'static str = "gateway";

    fn open(context: &Context, ports: &mut Ports) -> anyhow::Result<Self> {
        let resolved = &context.resolved;
        let parameters = NetworkParameters::of_drone(&resolved.pipeline);
        // Permanent errors end the start; the stage waits for temporary ones to pass.
        parameters.check().or_else(|error| if error.may_pass() { Ok(()) } else { Err(error) })?;
        let rotation = resolved.observer_from_camera.rotation;
        let report_hz = resolved.pipeline.gateway.report_hz;
        let flow = resolved.pipeline.flow();
        Ok(Self {
            tracks: ports.subscriber()?,
            rotations: ports.subscriber()?,
            odometries: ports.subscriber()?,
            peers: ports.publisher()?,
            swarms: ports.publisher()?,
            core: Core::new(&parameters.observer, rotation, flow, report_hz),
            parameters,
            link: None,
            generation: context.identity.generation,
            retry_ns: 0,
            detail_ns: 0,
            swarm_ns: 0,
            counters: context.counters.clone(),
        })
    }

    fn step(&mut self) -> anyhow::Result<Step> {
        let now_ns = clock::monotonic_ns();
        if self.link.is_none() && now_ns >= self.retry_ns {
            self.connect();
        }
        while let Some(message) = self.rotations.receive()? {
            self.core.on_rotation(&message.header);
        }
        while let Some(message) = self.odometries.receive()? {
            self.core.on_odometry(&message.header);
        }
        while let Some(message) = self.tracks.receive()? {
            let (now, link) = (ClockReading::now(), &self.link);
            let ahead_ns = now.utc_less_monotonic_ns();
            let clocks = || link.iter().flat_map(|link| link.clocks(ahead_ns)).collect();
            let due = self.core.on_tracks(&message.header, message.items(), now, clocks);
            if let Some((report, latency_ns)) = due {
                self.send(report, latency_ns);
            }
        }
        while let Some(heard) = self.link.as_ref().and_then(SwarmLink::next_sighting) {
            if let Some(sighting) = self.core.on_sighting(&heard) {
                let (arrived_ns, generation) = (heard.arrived_monotonic_ns, self.generation);
                self.peers.send(PeerHeader { arrived_ns, generation, reserved: 0 }, &[sighting])?;
            }
        }
        if now_ns >= self.swarm_ns {
            self.publish_swarm(now_ns)?;
        }
        if let Some(link) = &mut self.link
            && now_ns >= self.detail_ns
        {
            let left_out = self.core.left_out();
            self.counters.set_detail(link.look(&self.parameters.observer, &left_out));
            self.detail_ns = now_ns + DETAIL_NS;
        }
        let wait_ns = if self.link.is_some() { LISTEN_NS } else { DETAIL_NS };
        Ok(Step::WaitUntil(now_ns + wait_ns))
    }
}

impl GatewayStage {
    fn connect(&mut self) {
        match SwarmLink::open(&self.parameters) {
            Ok(link) => {
                self.link = Some(link);
                self.counters.set_state(None);
            }
            Err(error) => {
                self.counters.set_state(Some(StageState::Degraded));
                self.counters.set_detail(error.to_string());
                tracing::warn!("nothing goes over the network yet: {error}");
                self.retry_ns = clock::monotonic_ns() + RETRY_NS;
            }
        }
    }

    fn send(&mut self, report: FrameReport, latency_ns: i64) {
        let Some(link) = &mut self.link else { return self.counters.add_dropped(1) };
        let has_targets = !report.targets.is_empty();
        if !link.send(report) {
            return self.counters.add_failed(1);
        }
        self.counters.add_published(1);
        if has_targets {
            self.counters.add_latency_ns(latency_ns);
        }
    }

    fn publish_swarm(&mut self, now_ns: i64) -> anyhow::Result<()> {
        let poses = self.core.swarm(now_ns);
        let sent_ns = clock::monotonic_ns();
        let left_out = self.core.left_out().len() as u32;
        let header = SwarmHeader { at_ns: now_ns, sent_ns, generation: self.generation, left_out };
        self.swarms.send(header, &poses)?;
        self.swarm_ns = now_ns + SWARM_NS.max(SWARM_PAUSE * (sent_ns - now_ns));
        Ok(())
    }
}
