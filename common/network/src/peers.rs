//! Who is alive, and what each of them sees.

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

use flockeye_contract::wire::{PoseReport, WireError, is_name};

use crate::error::MAX_TARGETS;

/// Most observers that a listener keeps.
pub const MAX_OBSERVERS: usize = 64;

/// What a listener knows at one moment.
#[derive(Debug, Clone, Default)]
pub struct Peers {
    /// Everybody heard of, by name.
    pub observers: BTreeMap<String, PeerState>,
    /// Messages refused that belong to none of them: keys that are no Flockeye keys, and observers
    /// beyond [`MAX_OBSERVERS`].
    pub refused: u64,
}

/// What is known of one observer.
#[derive(Debug, Clone)]
pub struct PeerState {
    /// Whether its liveliness token stands.
    pub alive: bool,
    /// When `alive` took its value.
    pub since: Instant,
    /// The latest report on each target.
    pub targets: BTreeMap<String, Received>,
    /// Messages in its name that were refused.
    pub refused: u64,
}

/// The latest report on one target.
#[derive(Debug, Clone)]
pub struct Received {
    /// What was said.
    pub report: PoseReport,
    /// When it came in.
    pub arrived: Instant,
    /// The same, CLOCK_MONOTONIC of this machine, nanoseconds.
    pub arrived_monotonic_ns: i64,
    /// How many reports on this target came in.
    pub count: u64,
    interval_s: Option<f64>,
}

impl Received {
    /// How old the pose is at `now`; see [`age_of`].
    pub fn age(&self, now: Instant) -> Duration {
        age_of(self.arrived, self.report.latency_ms, now)
    }

    /// Reports per second, averaged over about the last ten, falling when none comes; none before
    /// the second report.
    pub fn rate_hz(&self, now: Instant) -> Option<f64> {
        let silent_s = now.saturating_duration_since(self.arrived).as_secs_f64();
        self.interval_s.map(|interval_s| 1.0 / interval_s.max(silent_s).max(1e-6))
    }
}

/// Age at `now` of a pose whose report came in at `arrived`: the time since then and the latency
/// that the sender reports. It needs no common clock, and leaves out the time on the air alone.
pub fn age_of(arrived: Instant, latency_ms: f64, now: Instant) -> Duration {
    // Any number may stand in a report; nonsense makes it old, never young.
    let latency = Duration::try_from_secs_f64(latency_ms.max(0.0) / 1e3).unwrap_or(Duration::MAX);
    now.saturating_duration_since(arrived).saturating_add(latency)
}

/// How a report came in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Way {
    /// Published just now.
    Published,
    /// The answer to a query, so possibly older than what was published meanwhile.
    LastValue,
}

/// When a report came in.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Arrival {
    pub(crate) at: Instant,
    pub(crate) monotonic_ns: i64,
    pub(crate) way: Way,
}

/// Why a message was refused.
#[derive(Debug, thiserror::Error)]
pub enum Refusal {
    /// Not a key under which an observer reports on a target.
    #[error("no key of a pose: names are letters, digits, '-', '_' or '.'")]
    Key,
    /// Not a report.
    #[error(transparent)]
    Wire(#[from] WireError),
    /// A report in another's name.
    #[error("the report is of '{found}', its key is not")]
    Observer {
        /// The observer in the report.
        found: String,
    },
    /// A report on another target.
    #[error("the report is on '{found}', its key is not")]
    Target {
        /// The target in the report.
        found: String,
    },
    /// No room for another observer.
    #[error("already {MAX_OBSERVERS} observers, which is the most")]
    TooManyObservers,
    /// No room for another target of this observer.
    #[error("already {MAX_TARGETS} targets of this observer, which is the most")]
    TooManyTargets,
}

impl Peers {
    /// Takes in a message on `key`; the report in it, or
    /// none where an answer to a query is older than what is held.
    pub(crate) fn take(
        &mut self,
        key: &str,
        payload: &[u8],
        arrival: Arrival,
    ) -> Result<Option<PoseReport>, Refusal> {
        let Some((observer, target)) = names_in(key) else {
            self.refused += 1;
            return Err(Refusal::Key);
        };
        let Some(peer) = self.peer(observer, arrival.at) else {
            self.refused += 1;
            return Err(Refusal::TooManyObservers);
        };
        let taken = read(payload, observer, target).and_then(|report| peer.put(report, arrival));
        if taken.is_err() {
            peer.refused += 1;
        }
        taken
    }

    /// Takes in that the token of `observer` stands or fell. False where there is no room for it.
    pub(crate) fn set_alive(&mut self, observer: &str, alive: bool, now: Instant) -> bool {
        let Some(peer) = self.peer(observer, now) else {
            self.refused += 1;
            return false;
        };
        if peer.alive != alive {
            (peer.alive, peer.since) = (alive, now);
        }
        true
    }

    /// The entry of `observer`, made where there is room.
    fn peer(&mut self, observer: &str, now: Instant) -> Option<&mut PeerState> {
        if !self.observers.contains_key(observer) && self.observers.len() == MAX_OBSERVERS {
            return None;
        }
        Some(self.observers.entry(observer.into()).or_insert_with(|| PeerState {
            alive: false,
            since: now,
            targets: BTreeMap::new(),
            refused: 0,
        }))
    }
}

impl PeerState {
    fn put(&mut self, report: PoseReport, arrival: Arrival) -> Result<Option<PoseReport>, Refusal> {
        let Some(held) = self.targets.get_mut(&report.target) else {
            if self.targets.len() == MAX_TARGETS {
                return Err(Refusal::TooManyTargets);
            }
            let received = Received {
                report: report.clone(),
                arrived: arrival.at,
                arrived_monotonic_ns: arrival.monotonic_ns,
                count: 1,
                interval_s: None,
            };
            self.targets.insert(report.target.clone(), received);
            return Ok(Some(report));
        };
        // What is published is newer whatever its stamps say: a drone may have been restarted.
        if arrival.way == Way::LastValue && report.stamp_utc_ns <= held.report.stamp_utc_ns {
            return Ok(None);
        }
        let interval_s = arrival.at.saturating_duration_since(held.arrived).as_secs_f64();
        held.interval_s =
            Some(held.interval_s.map_or(interval_s, |mean| mean + 0.1 * (interval_s - mean)));
        held.report = report.clone();
        held.arrived = arrival.at;
        held.arrived_monotonic_ns = arrival.monotonic_ns;
        held.count += 1;
        Ok(Some(report))
    }
}

/// The report in `payload`, which must be of `observer` on `target`.
fn read(payload: &[u8], observer: &str, target: &str) -> Result<PoseReport, Refusal> {
    let report = PoseReport::from_json(payload)?;
    if report.observer != observer {
        return Err(Refusal::Observer { found: shortened(report.observer) });
    }
    if report.target != target {
        return Err(Refusal::Target { found: shortened(report.target) });
    }
    Ok(report)
}

/// A name from outside, cut to what a log line bears.
fn shortened(name: String) -> String {
    name.chars().take(40).flat_map(char::escape_debug).collect()
}

/// Observer and target in the key of a pose, `flockeye/<swarm>/<observer>/sees/<target>/pose`.
fn names_in(key: &str) -> Option<(&str, &str)> {
    let parts: Vec<&str> = key.split('/').collect();
    match parts[..] {
        ["flockeye", _, observer, "sees", target, "pose"]
            if is_name(observer) && is_name(target) =>
        {
            Some((observer, target))
        }
        _ => None,
    }
}

/// Observer in the key of a liveliness token, `flockeye/<swarm>/<observer>/alive`.
pub(crate) fn observer_in(key: &str) -> Option<&str> {
    let parts: Vec<&str> = key.split('/').collect();
    match parts[..] {
        ["flockeye", _, observer, "alive"] if is_name(observer) => Some(observer),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use flockeye_contract::wire::{MAX_REPORT_BYTES, pose_key};

    use super::*;
    use crate::outbox::tests::report;

    fn arrival(at: Instant, way: Way) -> Arrival {
        Arrival { at, monotonic_ns: 7, way }
    }

    fn take(peers: &mut Peers, key: &str, payload: &[u8], at: Instant) -> Result<(), Refusal> {
        peers.take(key, payload, arrival(at, Way::Published)).map(drop)
    }

    #[test]
    fn age_counts_from_arrival_and_adds_the_senders_latency() {
        let arrived = Instant::now();
        let now = arrived + Duration::from_millis(300);
        assert_eq!(age_of(arrived, 120.0, now), Duration::from_millis(420));
        assert_eq!(age_of(now, 120.0, arrived), Duration::from_millis(120), "never negative");
        assert_eq!(age_of(arrived, -5e9, now), Duration::from_millis(300), "never young by lying");
        assert_eq!(age_of(arrived, 1e300, now), Duration::MAX);
    }

    #[test]
    fn the_latest_report_of_each_target_is_kept_with_its_rate() {
        let mut peers = Peers::default();
        let start = Instant::now();
        for frame in 0..50 {
            let at = start + Duration::from_millis(40 * frame);
            let report = PoseReport { frame, ..report("kite") };
            take(&mut peers, &pose_key("s", "wren", "kite"), &report.to_json().unwrap(), at)
                .unwrap();
        }
        let kite = &peers.observers["wren"].targets["kite"];
        assert_eq!((kite.report.frame, kite.count, kite.arrived_monotonic_ns), (49, 50, 7));
        let rate = |silent_ms| kite.rate_hz(kite.arrived + Duration::from_millis(silent_ms));
        assert!((rate(0).unwrap() - 25.0).abs() < 1e-6);
        assert!((rate(2_000).unwrap() - 0.5).abs() < 1e-6, "falls when nothing comes");
    }

    #[test]
    fn an_answer_never_replaces_what_was_published_after_it() {
        let mut peers = Peers::default();
        let (key, now) = (pose_key("s", "wren", "kite"), Instant::now());
        let mut send = |stamp_utc_ns, way| {
            let json = PoseReport { stamp_utc_ns, ..report("kite") }.to_json().unwrap();
            peers.take(&key, &json, arrival(now, way)).unwrap().is_some()
        };
        assert!(send(5, Way::LastValue));
        assert!(send(9, Way::Published));
        assert!(!send(8, Way::LastValue));
        assert!(send(3, Way::Published), "a restarted drone may be set back");
        assert!(send(4, Way::LastValue));
    }

    #[test]
    fn hostile_messages_are_counted_where_they_belong_and_change_nothing_else() {
        let mut peers = Peers::default();
        let now = Instant::now();
        let good = report("kite").to_json().unwrap();
        let key = pose_key("s", "wren", "kite");
        take(&mut peers, &key, &good, now).unwrap();
        let mut refused = |key: &str, payload: &[u8]| {
            take(&mut peers, key, payload, now).expect_err("refused").to_string()
        };
        assert!(refused(&key, b"{").starts_with("not a pose report"));
        assert!(refused(&key, &vec![b' '; MAX_REPORT_BYTES + 1]).contains("1201 bytes"));
        assert!(refused(&pose_key("s", "robin", "kite"), &good).contains("of 'wren'"));
        assert!(refused(&pose_key("s", "wren", "swift"), &good).contains("on 'kite'"));
        assert!(refused("flockeye/s/wren/sees/kite", &good).starts_with("no key"));
        assert!(refused("flockeye/s/wr\u{7}n/sees/kite/pose", &good).starts_with("no key"));
        assert_eq!((peers.refused, peers.observers["wren"].refused), (2, 3));
        assert_eq!(peers.observers["robin"].refused, 1);
        assert_eq!(peers.observers["wren"].targets["kite"].count, 1);
        assert!(peers.observers["robin"].targets.is_empty());
    }

    #[test]
    fn memory_is_bounded() {
        let mut peers = Peers::default();
        let now = Instant::now();
        for k in 0..MAX_TARGETS + 3 {
            let report = report(&format!("t{k}"));
            let key = pose_key("s", "wren", &report.target);
            let taken = take(&mut peers, &key, &report.to_json().unwrap(), now);
            assert_eq!(taken.is_ok(), k < MAX_TARGETS);
        }
        for k in 0..MAX_OBSERVERS + 3 {
            assert_eq!(peers.set_alive(&format!("o{k}"), true, now), k < MAX_OBSERVERS - 1);
        }
        assert_eq!(peers.observers["wren"].targets.len(), MAX_TARGETS);
        assert_eq!(peers.observers["wren"].refused, 3);
        assert_eq!((peers.observers.len(), peers.refused), (MAX_OBSERVERS, 4));
    }

    #[test]
    fn alive_says_since_when() {
        let mut peers = Peers::default();
        let start = Instant::now();
        let at = |seconds| start + Duration::from_secs(seconds);
        for (second, alive) in [(1, true), (2, true), (3, false)] {
            assert!(peers.set_alive("wren", alive, at(second)));
            let since = peers.observers["wren"].since;
            assert_eq!(since, at(if alive { 1 } else { 3 }));
        }
        assert_eq!(observer_in("flockeye/s/wren/alive"), Some("wren"));
        assert_eq!(observer_in("flockeye/s/wr n/alive"), None);
    }
}
