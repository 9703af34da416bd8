//! The link with the swarm, and what it says in words for people.

use std::collections::BTreeMap;
use std::sync::Arc;

use flockeye_contract::wire::{ClockOffset, FrameReport};
use flockeye_network::{
    Listener, Network, NetworkError, NetworkParameters, ReportStream, Reporter, TimedSighting,
};
use flockeye_runtime::logs::Throttle;

use crate::in_words::in_words;
use crate::security_warnings::SecurityWarnings;

/// Reports of peers that may wait for the next look.
const WAITING_REPORTS: usize = 1_024;

/// The session, and what is sent and received by it.
pub(crate) struct SwarmLink {
    network: Network,
    security: SecurityWarnings,
    reporter: Reporter,
    listener: Listener,
    reports: Arc<ReportStream>,
    failures: Throttle,
}

impl SwarmLink {
    /// Opens the session.
    ///
    /// # Errors
    /// A port that is taken, keys that cannot be used.
    pub(crate) fn open(parameters: &NetworkParameters) -> Result<Self, NetworkError> {
        let network = Network::open(parameters)?;
        let listener = network.listener()?;
        let reports = listener.stream(WAITING_REPORTS);
        let reporter = network.reporter()?;
        Ok(Self {
            network,
            security: SecurityWarnings::default(),
            reporter,
            listener,
            reports,
            failures: Throttle::default(),
        })
    }

    /// Sends a report and returns at once. False, with a warning, where no peer would accept it.
    pub(crate) fn send(&mut self, report: FrameReport) -> bool {
        let sent = self.reporter.report(report);
        if let Err(error) = &sent
            && let Some(more) = self.failures.admit()
        {
            tracing::warn!(more_since = more, "a report cannot be sent: {error}");
        }
        sent.is_ok()
    }

    /// The next sighting of a peer, if one has come.
    pub(crate) fn next_sighting(&self) -> Option<TimedSighting> {
        self.reports.try_recv()
    }

    /// How the peers' clocks differ from this machine's, whose UTC is so far ahead of
    /// CLOCK_MONOTONIC.
    pub(crate) fn clocks(&self, utc_less_monotonic_ns: i64) -> BTreeMap<String, ClockOffset> {
        let clocks = self.listener.snapshot().clocks(utc_less_monotonic_ns);
        clocks.into_iter().map(|(peer, clock)| (peer, clock.to_wire())).collect()
    }

    /// Logs what has happened to the link itself, and gives who is there in words.
    pub(crate) fn look(&mut self, own_name: &str, left_out: &[String]) -> String {
        self.security.look(&self.network);
        in_words(&self.listener.snapshot(), own_name, left_out)
    }
}
