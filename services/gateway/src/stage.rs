//! The ports around the network.

use flockeye_config::Flow;
use flockeye_contract::{FrameStamp, StageState, Track, Tracks};
use flockeye_network::{
    Listener, Network, NetworkError, NetworkParameters, Reporter, utc_from_monotonic,
};
use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::logs::Throttle;
use flockeye_runtime::ports::{Ports, Subscriber};
use flockeye_runtime::{Context, Stage, Step, clock};

use crate::hearsay::in_words;
use crate::newest::Newest;
use crate::report::{Utc, report};

/// How often a network that cannot be had is tried again, nanoseconds.
const RETRY_NS: i64 = 5_000_000_000;
/// How often what the peers say is put into words, nanoseconds.
const DETAIL_NS: i64 = 500_000_000;

/// Takes tracks; gives reports to the swarm, and hears the others'.
pub struct GatewayStage {
    tracks: Subscriber<Tracks>,
    parameters: NetworkParameters,
    link: Option<Link>,
    retry_ns: i64,
    detail_ns: i64,
    flow: Flow,
    newest: Newest,
    counters: SharedCounters,
    failures: Throttle,
}

struct Link {
    reporter: Reporter,
    listener: Listener,
}

impl Stage for GatewayStage {
    const NAME: &'static str = "gateway";

    fn open(context: &Context, ports: &mut Ports) -> anyhow::Result<Self> {
        let parameters = NetworkParameters::of_drone(&context.resolved.pipeline);
        // What can never work is said before the flight; what may come yet is waited for.
        parameters.check()?;
        Ok(Self {
            tracks: ports.subscriber()?,
            parameters,
            link: None,
            retry_ns: 0,
            detail_ns: 0,
            flow: context.resolved.pipeline.flow,
            newest: Newest::default(),
            counters: context.counters.clone(),
            failures: Throttle::default(),
        })
    }

    fn step(&mut self) -> anyhow::Result<Step> {
        let now_ns = clock::monotonic_ns();
        if self.link.is_none() && now_ns >= self.retry_ns {
            self.connect();
        }
        while let Some(message) = self.tracks.receive()? {
            let stamp = message.header.stamp;
            for track in message.items() {
                if self.newest.is_newest(track.target, &stamp) {
                    self.send(&stamp, track);
                }
            }
        }
        if let Some(link) = &self.link
            && now_ns >= self.detail_ns
        {
            self.counters
                .set_detail(in_words(&link.listener.snapshot(), &self.parameters.observer));
            self.detail_ns = now_ns + DETAIL_NS;
        }
        Ok(Step::WaitUntil(now_ns + DETAIL_NS))
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

    fn send(&mut self, stamp: &FrameStamp, track: &Track) {
        let now_ns = clock::monotonic_ns();
        // In a lossless run the exposure has the recording's clock: what counts is the publication.
        let seen_ns = match self.flow {
            Flow::Latest => stamp.exposure_ns,
            Flow::Lossless => stamp.published_ns,
        };
        let (stamp_ns, is_synchronised) = utc_from_monotonic(seen_ns);
        let utc = Utc { stamp_ns, is_synchronised };
        let Some(report) = report(&self.parameters.observer, stamp, track, utc, now_ns - seen_ns)
        else {
            return;
        };
        let Some(link) = &self.link else {
            self.counters.add_dropped(1);
            return;
        };
        match link.reporter.report(&report) {
            Ok(()) => {
                self.counters.add_published(1);
                self.counters.add_latency_ns(now_ns - seen_ns);
            }
            Err(error) => {
                self.counters.add_failed(1);
                if let Some(more) = self.failures.admit() {
                    tracing::warn!(more_since = more, "a report cannot be sent: {error}");
                }
            }
        }
    }
}

fn open(parameters: &NetworkParameters) -> Result<Link, NetworkError> {
    let network = Network::open(parameters)?;
    Ok(Link { reporter: network.reporter()?, listener: network.listener()? })
}
