//! The peers that are alive, and their sightings.

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

use flockeye_contract::wire::{FrameReport, MAX_TARGETS, Sighting, is_name, shortened};
use flockeye_identity::Untrusted;

use crate::clock::ClockEstimate;
use crate::freshness::{ClockReading, Freshness};
use crate::refusal::{MAX_OBSERVERS, Refusal, Refused};
use crate::waiting::is_overdue;

/// A listener's table at one moment.
#[derive(Debug, Clone, Default)]
pub struct Peers {
    /// All known observers, by name.
    pub observers: BTreeMap<String, PeerState>,
    /// Refused messages that belong to none of them: keys without a valid form, and observers
    /// beyond the maximum of 64.
    pub refused: u64,
    /// This drone's own name, where it reports too. It selects the peers' estimates of its clock.
    own: Option<String>,
    /// Whether reports are signed.
    is_secure: bool,
}

/// State of one observer.
#[derive(Debug, Clone)]
pub struct PeerState {
    /// Whether its liveliness token exists.
    pub alive: bool,
    /// Time of the last change of `alive`.
    pub since: Instant,
    /// Whether it has answered the query for its last values, or the query has timed out. From then
    /// on no report is missing.
    pub is_heard: bool,
    /// The latest report on each target.
    pub targets: BTreeMap<String, LatestSighting>,
    /// Refused messages in its name.
    pub refused: Refused,
    freshness: Freshness,
    /// Whether reports are signed.
    is_secure: bool,
    /// Arrival of the first and of the last message before the observer's answer; none before the
    /// first.
    unanswered: Option<(Instant, Instant)>,
}

/// The latest report on one target.
#[derive(Debug, Clone)]
pub struct LatestSighting {
    /// The report.
    pub report: Sighting,
    /// Time of arrival.
    pub arrived: Instant,
    /// The arrival, CLOCK_MONOTONIC of this machine, nanoseconds.
    pub arrived_monotonic_ns: i64,
    /// Number of reports on this target.
    pub count: u64,
    interval_s: Option<f64>,
}

impl LatestSighting {
    /// Age of the pose at `now`; see [`age_of`].
    pub fn age(&self, now: Instant) -> Duration {
        age_of(self.arrived, self.report.latency_ms, now)
    }

    /// Reports per second, averaged over about the last ten; it falls during silence. None before
    /// the second report.
    pub fn rate_hz(&self, now: Instant) -> Option<f64> {
        let silent_s = now.saturating_duration_since(self.arrived).as_secs_f64();
        self.interval_s.map(|interval_s| 1.0 / interval_s.max(silent_s).max(1e-6))
    }
}

/// Age at `now` of a pose whose report arrived at `arrived`. It is the time since then plus the
/// latency in the report. It needs no common clock, and omits only the transit time.
pub(crate) fn age_of(arrived: Instant, latency_ms: f64, now: Instant) -> Duration {
    // The number may be invalid; then it makes the pose old, never young.
    let latency = Duration::try_from_secs_f64(latency_ms.max(0.0) / 1e3).unwrap_or(Duration::MAX);
    now.saturating_duration_since(arrived).saturating_add(latency)
}

/// The way in which a report arrived.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Delivery {
    Published,
    /// The answer to a query, which may be older than published reports.
    LastValue,
}

/// Time and way of a message's arrival.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Arrival {
    pub(crate) at: Instant,
    pub(crate) time: ClockReading,
    pub(crate) delivery: Delivery,
}

impl Peers {
    /// The table of a listener that belongs to the drone `own`, or to none. With `is_secure` it
    /// accepts only signed messages.
    pub(crate) fn of(own: Option<String>, is_secure: bool) -> Self {
        Self { own, is_secure, ..Self::default() }
    }

    /// Counts a message in the name of `observer` that lacks its signature.
    pub(crate) fn refuse(
        &mut self,
        observer: &str,
        untrusted: Untrusted,
        arrival: &Arrival,
    ) -> Refusal {
        let Some(peer) = self.peer(observer, arrival.at) else {
            self.refused += 1;
            return untrusted.into();
        };
        let refusal = match untrusted {
            // Its certificate arrives with its answer.
            Untrusted::NotKnown if peer.must_answer(&arrival.time) => peer.unanswered(arrival.at),
            other => other.into(),
        };
        peer.refused.count(&refusal);
        refusal
    }

    /// Takes a message and returns its sightings. It is empty where an answer to a query is older
    /// than the table.
    pub(crate) fn take(
        &mut self,
        key: &str,
        payload: &[u8],
        arrival: Arrival,
    ) -> Result<Vec<Sighting>, Refusal> {
        let Some(observer) = observer_in(key) else {
            self.refused += 1;
            return Err(Refusal::Key);
        };
        let own = self.own.clone();
        let Some(peer) = self.peer(observer, arrival.at) else {
            self.refused += 1;
            return Err(Refusal::TooManyObservers);
        };
        let taken = peer.take(observer, payload, arrival, own.as_deref());
        if let Err(refusal) = &taken {
            peer.refused.count(refusal);
        }
        taken
    }

    /// Notes whether the token of `observer` exists. False where there is no room for the observer.
    pub(crate) fn set_alive(&mut self, observer: &str, alive: bool, now: Instant) -> bool {
        let Some(peer) = self.peer(observer, now) else {
            self.refused += 1;
            return false;
        };
        if peer.alive != alive {
            (peer.alive, peer.since) = (alive, now);
            peer.is_heard &= alive;
            // An observer that returns may have been restarted with another clock.
            peer.freshness = Freshness::default();
        }
        true
    }

    /// Notes that the query to `observer` is over.
    pub(crate) fn set_heard(&mut self, observer: &str) {
        if let Some(peer) = self.observers.get_mut(observer) {
            peer.is_heard = peer.alive;
        }
    }

    /// Offset of each living observer's clock, where this machine's UTC is `utc_less_monotonic_ns`
    /// ahead of CLOCK_MONOTONIC.
    pub fn clocks(&self, utc_less_monotonic_ns: i64) -> BTreeMap<String, ClockEstimate> {
        let estimates = self.observers.iter().filter(|(_, peer)| peer.alive);
        estimates
            .filter_map(|(name, peer)| Some((name.clone(), peer.clock(utc_less_monotonic_ns)?)))
            .collect()
    }

    /// The entry of `observer`; a new one is created where there is room.
    fn peer(&mut self, observer: &str, now: Instant) -> Option<&mut PeerState> {
        if !self.observers.contains_key(observer) && self.observers.len() == MAX_OBSERVERS {
            return None;
        }
        let is_secure = self.is_secure;
        Some(self.observers.entry(observer.into()).or_insert_with(|| PeerState {
            alive: false,
            since: now,
            is_heard: false,
            targets: BTreeMap::new(),
            refused: Refused::default(),
            freshness: Freshness::default(),
            is_secure,
            unanswered: None,
        }))
    }
}

impl PeerState {
    /// Offset of its clock, where this machine's UTC is `utc_less_monotonic_ns` ahead of
    /// CLOCK_MONOTONIC.
    pub fn clock(&self, utc_less_monotonic_ns: i64) -> Option<ClockEstimate> {
        self.freshness.way.estimate(utc_less_monotonic_ns)
    }

    fn take(
        &mut self,
        observer: &str,
        payload: &[u8],
        arrival: Arrival,
        own: Option<&str>,
    ) -> Result<Vec<Sighting>, Refusal> {
        let report = read_frame(payload, observer)?;
        self.pass(&report, &arrival)?;
        if let Some(clock) = own.and_then(|own| report.clocks.get(own)) {
            self.freshness.way.hear_back(clock);
        }
        let mut taken = Vec::new();
        let mut refused = None;
        for sighting in report.sightings() {
            match self.put(sighting, arrival) {
                Ok(sighting) => taken.extend(sighting),
                Err(full) => refused = Some(full),
            }
        }
        match refused {
            Some(full) if taken.is_empty() => Err(full),
            _ => Ok(taken),
        }
    }

    /// Accepts a published report if it is fresh. An answer to a query is older by nature, so it
    /// only fills gaps or replaces older data. Where reports are signed, an observer must answer a
    /// recent query before its reports are accepted.
    fn pass(&mut self, report: &FrameReport, arrival: &Arrival) -> Result<(), Refusal> {
        let sent_utc_ns = report.sent_utc_ns();
        match arrival.delivery {
            Delivery::Published if self.must_answer(&arrival.time) => {
                return Err(self.unanswered(arrival.at));
            }
            Delivery::Published => {
                self.freshness.pass(sent_utc_ns, report.clock_synchronised, &arrival.time)?;
            }
            Delivery::LastValue if self.must_answer(&arrival.time) => {
                self.unanswered = None;
                self.freshness.begin(sent_utc_ns, &arrival.time);
            }
            Delivery::LastValue => self.freshness.note(sent_utc_ns),
        }
        Ok(())
    }

    /// Whether the observer must answer a query first. This holds for signed reports after a
    /// silence, because they may be replays.
    fn must_answer(&self, now: &ClockReading) -> bool {
        self.is_secure && self.freshness.begins_anew(now)
    }

    /// The refusal of a message from an observer that has not answered.
    fn unanswered(&mut self, now: Instant) -> Refusal {
        if is_overdue(&mut self.unanswered, now) {
            Refusal::NotAnswered
        } else {
            Refusal::NotYetAnswered
        }
    }

    fn put(&mut self, report: Sighting, arrival: Arrival) -> Result<Option<Sighting>, Refusal> {
        let Some(held) = self.targets.get_mut(&report.target.name) else {
            if self.targets.len() == MAX_TARGETS {
                return Err(Refusal::TooManyTargets);
            }
            let received = LatestSighting {
                report: report.clone(),
                arrived: arrival.at,
                arrived_monotonic_ns: arrival.time.monotonic_ns,
                count: 1,
                interval_s: None,
            };
            self.targets.insert(report.target.name.clone(), received);
            return Ok(Some(report));
        };
        if arrival.delivery == Delivery::LastValue
            && report.stamp_utc_ns <= held.report.stamp_utc_ns
        {
            return Ok(None);
        }
        // A frame is reported again when more targets of it are known; that is nothing new for this
        // target.
        let is_same = (report.epoch, report.frame) == (held.report.epoch, held.report.frame);
        if !is_same {
            let interval_s = arrival.at.saturating_duration_since(held.arrived).as_secs_f64();
            held.interval_s =
                Some(held.interval_s.map_or(interval_s, |mean| mean + 0.1 * (interval_s - mean)));
        }
        let is_repeated = is_same && report.target == held.report.target;
        held.report = report.clone();
        held.arrived = arrival.at;
        held.arrived_monotonic_ns = arrival.time.monotonic_ns;
        held.count += u64::from(!is_same);
        Ok((!is_repeated).then_some(report))
    }
}

/// Reads the report in `payload`, which must be by `observer`.
fn read_frame(payload: &[u8], observer: &str) -> Result<FrameReport, Refusal> {
    let report = FrameReport::from_json(payload)?;
    if report.observer != observer {
        return Err(Refusal::Observer { found: shortened(&report.observer) });
    }
    Ok(report)
}

/// The observer in the key of a report, `flockeye/<swarm>/<observer>/sees`.
pub(crate) fn observer_in(key: &str) -> Option<&str> {
    name_before(key, "sees")
}

/// The observer in the key of a liveliness token, `flockeye/<swarm>/<observer>/alive`.
pub(crate) fn alive_in(key: &str) -> Option<&str> {
    name_before(key, "alive")
}

fn name_before<'k>(key: &'k str, last: &str) -> Option<&'k str> {
    let parts: Vec<&str> = key.split('/').collect();
    match parts[..] {
        ["flockeye", _, observer, end] if end == last && is_name(observer) => Some(observer),
        _ => None,
    }
}

#[cfg(test)]
mod tests;
