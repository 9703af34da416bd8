//! The link with the swarm, and a text on its state for people.

use std::collections::BTreeMap;
use std::sync::Arc;

use flockeye_contract::wire::{ClockOffset, FrameReport};
use flockeye_network::{
    Listener, Network, NetworkError, NetworkParameters, ReportStream, Reporter, TimedSighting,
};
use flockeye_runtime::logs::Throttle;

use crate::in_words::in_words;
use crate::security_warnings::SecurityWarnings;

/// Maximum reports of peers that wait until they are read.
const WAITING_REPORTS: usize = 1_024;

/// The session with its reporter and listener.
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
    /// A port is in use, or keys are invalid.
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

    /// Sends a report and returns at once. False, with a warning, for a report that peers would
    /// refuse.
    pub(crate) fn send(&mut self, report: FrameReport) -> bool {
        let sent = self.reporter.report(report);
        if let Err(error) = &sent
            && let Some(more) = self.failures.admit()
        {
            tracing::warn!(more_since = more, "a report cannot be sent: {error}");
        }
        sent.is_ok()
    }

    /// The next sighting of a peer, if one waits.
    pub(crate) fn next_sighting(&self) -> Option<TimedSighting> {
        self.reports.try_recv()
    }

    /// Offsets of the peers' clocks, where this machine's UTC is `utc_less_monotonic_ns` ahead of
    /// CLOCK_MONOTONIC.
    pub(crate) fn clocks(&self, utc_less_monotonic_ns: i64) -> BTreeMap<String, ClockOffset> {
        let clocks = self.listener.snapshot().clocks(utc_less_monotonic_ns);
        clocks.into_iter().map(|(peer, clock)| (peer, clock.to_wire())).collect()
    }

    /// Logs security warnings of the link, and returns the peers' state as text.
    pub(crate) fn look(&mut self, own_name: &str, left_out: &[String]) -> String {
        self.security.look(&self.network);
        in_words(&self.listener.snapshot(), own_name, left_out)
    }
}
