//! A link to a swarm.

use std::sync::Arc;

use flockeye_network::{
    LatestSighting, Listener, Network, NetworkError, NetworkParameters, Peers, ReportStream,
};

/// Maximum reports that wait to be read.
const WAITING: usize = 1_024;

/// Receives the reports of a swarm, and publishes nothing.
#[derive(Debug)]
pub struct Client {
    listener: Listener,
}

impl Client {
    /// Connects to `endpoints` (`tcp/10.0.0.7:7447`), which are drones or routers, again whenever a
    /// link breaks. Returns at once, even while none of them is there.
    ///
    /// # Errors
    /// An endpoint or the name is invalid, or no session can be opened.
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

    /// Connects with these parameters.
    ///
    /// # Errors
    /// As [`connect`](Self::connect).
    pub fn open(parameters: &NetworkParameters) -> Result<Self, NetworkError> {
        Ok(Self { listener: Network::open(parameters)?.listener()? })
    }

    /// A stream of every report from now on ([`PeerReport`](crate::PeerReport) has its types). A
    /// slow reader loses the oldest.
    pub fn reports(&self) -> Arc<ReportStream> {
        self.listener.stream(WAITING)
    }

    /// The table of all drones: those that are alive, their sightings, and refused messages.
    pub fn peers(&self) -> Peers {
        self.listener.snapshot()
    }

    /// The last report of `observer` on `target`, with its age ([`LatestSighting::age`]).
    pub fn last_known(&self, observer: &str, target: &str) -> Option<LatestSighting> {
        self.peers().observers.get(observer)?.targets.get(target).cloned()
    }
}
