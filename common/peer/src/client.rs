//! A link to a swarm.

use std::sync::Arc;

use flockeye_network::{
    LatestSighting, Listener, Network, NetworkError, NetworkParameters, Peers, ReportStream,
};

/// Reports that may wait to be read.
const WAITING: usize = 1_024;

/// Hears a swarm, and says nothing itself.
#[derive(Debug)]
pub struct Client {
    listener: Listener,
}

impl Client {
    /// Links with `endpoints` (`tcp/10.0.0.7:7447`): drones or routers, found again whenever a link
    /// breaks. Returns at once, also while none of them is there.
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

    /// Every report from now on, one by one ([`PeerReport`](crate::PeerReport) has its types). A
    /// reader that falls behind loses the oldest.
    pub fn reports(&self) -> Arc<ReportStream> {
        self.listener.stream(WAITING)
    }

    /// What is known of all drones: who is alive, what each sees, whose messages were refused.
    pub fn peers(&self) -> Peers {
        self.listener.snapshot()
    }

    /// The last report of `observer` on `target`, with its age ([`LatestSighting::age`]).
    pub fn last_known(&self, observer: &str, target: &str) -> Option<LatestSighting> {
        self.peers().observers.get(observer)?.targets.get(target).cloned()
    }
}
