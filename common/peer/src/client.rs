//! A link to a swarm.

use std::time::Duration;

use flockeye_network::{
    Listener, Network, NetworkError, NetworkParameters, PeerState, Peers, ReportStream,
};

use crate::report::PeerReport;

/// Reports that may wait to be read.
const WAITING: usize = 1_024;

/// Hears a swarm, and says nothing itself.
#[derive(Debug)]
pub struct Client {
    listener: Listener,
}

impl Client {
    /// Links with `endpoints` (`tcp/10.0.0.7:7447`): drones or routers, found again whenever a link breaks. Returns
    /// at once, also while none of them is there.
    ///
    /// # Errors
    /// An endpoint or the name cannot be one, or no session can be opened.
    pub fn connect(endpoints: &[&str], swarm: &str) -> Result<Self, NetworkError> {
        let parameters = NetworkParameters {
            swarm: swarm.into(),
            listen: Vec::new(),
            connect: endpoints.iter().map(|&endpoint| endpoint.into()).collect(),
            is_onlooker: true,
            ..NetworkParameters::default()
        };
        Self::open(&parameters)
    }

    /// Links as the parameters say.
    ///
    /// # Errors
    /// As [`connect`](Self::connect).
    pub fn open(parameters: &NetworkParameters) -> Result<Self, NetworkError> {
        Ok(Self { listener: Network::open(parameters)?.listener()? })
    }

    /// Every report from now on, one by one. A reader that falls behind loses the oldest.
    pub fn reports(&self) -> Reports {
        Reports { stream: self.listener.stream(WAITING) }
    }

    /// What is known of all drones: who is alive, what each sees, whose messages were refused.
    pub fn peers(&self) -> Peers {
        self.listener.snapshot()
    }

    /// The last report of `observer` on `target`, with its age ([`flockeye_network::LatestSighting::age`]).
    pub fn last_known(
        &self,
        observer: &str,
        target: &str,
    ) -> Option<flockeye_network::LatestSighting> {
        let peers = self.listener.snapshot();
        let observer: &PeerState = peers.observers.get(observer)?;
        observer.targets.get(target).cloned()
    }
}

/// Reports as they come.
#[derive(Debug)]
pub struct Reports {
    stream: ReportStream,
}

impl Reports {
    /// The next report; none where none came within `patience`, or the client is gone.
    pub fn next_within(&self, patience: Duration) -> Option<PeerReport> {
        self.stream.recv_timeout(patience).as_ref().map(PeerReport::from)
    }

    /// How many reports this reader was too slow for.
    pub fn missed(&self) -> u64 {
        self.stream.dropped()
    }
}
