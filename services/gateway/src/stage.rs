//! The ports around the network.

use flockeye_config::{Flow, Gateway};
use flockeye_contract::{
    FrameStamp, PeerHeader, Peers, Rotations, StageState, SwarmHeader, Swarms, Track, TrackHeader,
    Tracks,
};
use flockeye_network::{
    Listener, Network, NetworkError, NetworkParameters, ReportStream, Reporter, utc_from_monotonic,
};
use flockeye_peer::PeerReport;
use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::logs::Throttle;
use flockeye_runtime::ports::{Ports, Publisher, Subscriber};
use flockeye_runtime::{Context, Stage, Step, clock};

use crate::frame::{Gathering, Head, Utc};
use crate::guard::Guard;
use crate::hearsay::in_words;
use crate::newest::Newest;
use crate::pace::Pace;
use crate::pilot::Pilot;
use crate::ros::Ros;
use crate::swarm::Swarm;

/// How often a network that cannot be had is tried again, nanoseconds.
const RETRY_NS: i64 = 5_000_000_000;
/// How often what the peers say is put into words, nanoseconds.
const DETAIL_NS: i64 = 500_000_000;
/// How often it is looked whether a peer has said something, nanoseconds.
const LISTEN_NS: i64 = 10_000_000;
/// How often the swarm's poses are published, nanoseconds.
const SWARM_NS: i64 = 100_000_000;
/// After the swarm's poses, at least so many times as long goes by without.
const SWARM_PAUSE: i64 = 10;
/// Reports that may wait for the next look.
const WAITING_REPORTS: usize = 1_024;

/// Takes tracks; gives reports to the swarm, and hears the others'.
pub struct GatewayStage {
    tracks: Subscriber<Tracks>,
    rotations: Subscriber<Rotations>,
    peers: Publisher<Peers>,
    swarms: Publisher<Swarms>,
    parameters: NetworkParameters,
    link: Option<Link>,
    gathering: Gathering,
    swarm: Swarm,
    ros: Option<Ros>,
    pilot: Option<Pilot>,
    generation: u32,
    retry_ns: i64,
    detail_ns: i64,
    swarm_ns: i64,
    flow: Flow,
    newest: Newest,
    pace: Pace,
    counters: SharedCounters,
    failures: Throttle,
}

struct Link {
    network: Network,
    guard: Guard,
    reporter: Reporter,
    listener: Listener,
    reports: ReportStream,
}

impl Stage for GatewayStage {
    const NAME: &'static str = "gateway";

    fn open(context: &Context, ports: &mut Ports) -> anyhow::Result<Self> {
        let resolved = &context.resolved;
        let parameters = NetworkParameters::of_drone(&resolved.pipeline);
        // What can never work is said before the flight; what may come yet is waited for.
        parameters.check().or_else(|error| if error.may_pass() { Ok(()) } else { Err(error) })?;
        let Gateway { ros2: ros, autopilot, report_hz, .. } = &resolved.pipeline.gateway;
        Ok(Self {
            tracks: ports.subscriber()?,
            rotations: ports.subscriber()?,
            peers: ports.publisher()?,
            swarms: ports.publisher()?,
            swarm: Swarm::new(&parameters.observer, resolved.observer_from_camera.rotation),
            gathering: Gathering::default(),
            ros: ros.as_ref().map(|ros| Ros::open(ros, &parameters.observer)).transpose()?,
            pilot: autopilot.as_ref().map(Pilot::open).transpose()?,
            parameters,
            link: None,
            generation: context.identity.generation,
            retry_ns: 0,
            detail_ns: 0,
            swarm_ns: 0,
            flow: resolved.pipeline.flow,
            newest: Newest::default(),
            pace: Pace::new(*report_hz),
            counters: context.counters.clone(),
            failures: Throttle::default(),
        })
    }

    fn step(&mut self) -> anyhow::Result<Step> {
        let now_ns = clock::monotonic_ns();
        if self.link.is_none() && now_ns >= self.retry_ns {
            self.connect();
        }
        while let Some(message) = self.rotations.receive()? {
            self.swarm.turned(&message.header);
        }
        self.take_tracks(now_ns)?;
        self.hear()?;
        if now_ns >= self.swarm_ns {
            self.publish_swarm(now_ns)?;
        }
        if let Some(link) = &mut self.link
            && now_ns >= self.detail_ns
        {
            link.guard.look(&link.network);
            let peers = link.listener.snapshot();
            let left_out = self.swarm.left_out();
            self.counters.set_detail(in_words(&peers, &self.parameters.observer, &left_out));
            self.detail_ns = now_ns + DETAIL_NS;
        }
        let wait_ns = if self.link.is_some() { LISTEN_NS } else { DETAIL_NS };
        Ok(Step::WaitUntil(now_ns + wait_ns))
    }
}

impl GatewayStage {
    fn connect(&mut self) {
        match open(&self.parameters) {
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

    /// Takes what fusion says, and tells everybody.
    fn take_tracks(&mut self, now_ns: i64) -> anyhow::Result<()> {
        while let Some(message) = self.tracks.receive()? {
            let TrackHeader { stamp, is_last, .. } = message.header;
            let exposure = Exposure::of(&stamp, self.flow);
            let is_reported = self.pace.admits(&stamp, exposure.monotonic_ns);
            let mut newest = message.items().to_vec();
            newest.retain(|track| self.newest.is_newest(track.target, &stamp));
            for track in &newest {
                self.swarm.sees(&stamp, exposure.monotonic_ns, track);
                if let Some(pilot) = &mut self.pilot {
                    pilot.sees(exposure.monotonic_ns, track);
                }
            }
            if let Some(ros) = &mut self.ros {
                ros.sees(exposure.utc.stamp_ns, &newest);
            }
            if is_reported && self.gathering.take(&stamp, message.items(), is_last != 0, now_ns) {
                self.send_frame(&exposure);
            }
        }
        Ok(())
    }

    /// Reports a frame as far as it is known.
    fn send_frame(&mut self, exposure: &Exposure) {
        let Some(link) = &self.link else {
            self.counters.add_dropped(1);
            return;
        };
        let now_ns = clock::monotonic_ns();
        let pilot = self.pilot.as_ref();
        let latency_ns = now_ns - exposure.monotonic_ns;
        let head = Head {
            observer: &self.parameters.observer,
            utc: exposure.utc,
            latency_ns,
            odometry: pilot.and_then(|pilot| pilot.odometry(exposure.monotonic_ns)),
        };
        let clocks = || {
            let utc_less_monotonic_ns = exposure.utc.stamp_ns.saturating_sub(exposure.monotonic_ns);
            let clocks = link.listener.snapshot().clocks(utc_less_monotonic_ns);
            clocks.into_iter().map(|(peer, clock)| (peer, clock.to_wire())).collect()
        };
        let report = self.gathering.report(head, now_ns, clocks);
        let has_targets = !report.targets.is_empty();
        match link.reporter.report(report) {
            Ok(()) => {
                self.counters.add_published(1);
                if has_targets {
                    self.counters.add_latency_ns(latency_ns);
                }
            }
            Err(error) => self.fail(&error),
        }
    }

    fn fail(&mut self, error: &NetworkError) {
        self.counters.add_failed(1);
        if let Some(more) = self.failures.admit() {
            tracing::warn!(more_since = more, "a report cannot be sent: {error}");
        }
    }

    /// Passes on what the peers have said.
    fn hear(&mut self) -> anyhow::Result<()> {
        let Some(link) = &self.link else { return Ok(()) };
        while let Some(heard) = link.reports.try_recv() {
            if heard.report.observer == self.parameters.observer {
                continue;
            }
            let report = PeerReport::from(&heard);
            self.swarm.hears(&report);
            if let Some(ros) = &mut self.ros
                && report.target == self.parameters.observer
            {
                ros.is_seen(&heard, &report);
            }
            let header = PeerHeader {
                arrived_ns: heard.arrived_monotonic_ns,
                generation: self.generation,
                reserved: 0,
            };
            self.peers.send(header, &[self.swarm.peer_sighting(&report)])?;
        }
        Ok(())
    }

    /// Says where all drones are.
    fn publish_swarm(&mut self, now_ns: i64) -> anyhow::Result<()> {
        let poses = self.swarm.poses(now_ns);
        let sent_ns = clock::monotonic_ns();
        let left_out = self.swarm.left_out().len() as u32;
        let header = SwarmHeader { at_ns: now_ns, sent_ns, generation: self.generation, left_out };
        self.swarms.send(header, &poses)?;
        self.swarm_ns = now_ns + SWARM_NS.max(SWARM_PAUSE * (sent_ns - now_ns));
        Ok(())
    }
}

/// When a frame was exposed, on this machine's clocks.
struct Exposure {
    monotonic_ns: i64,
    utc: Utc,
}

impl Exposure {
    /// In a lossless run the exposure has the recording's clock: what counts is the publication.
    fn of(stamp: &FrameStamp, flow: Flow) -> Self {
        let monotonic_ns = match flow {
            Flow::Latest => stamp.exposure_ns,
            Flow::Lossless => stamp.published_ns,
        };
        let (stamp_ns, is_synchronised) = utc_from_monotonic(monotonic_ns);
        Self { monotonic_ns, utc: Utc { stamp_ns, is_synchronised } }
    }
}

fn open(parameters: &NetworkParameters) -> Result<Link, NetworkError> {
    let network = Network::open(parameters)?;
    let listener = network.listener()?;
    let reports = listener.stream(WAITING_REPORTS);
    let reporter = network.reporter()?;
    Ok(Link { network, guard: Guard::default(), reporter, listener, reports })
}
