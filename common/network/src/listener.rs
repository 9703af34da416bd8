//! Receives the reports of other drones.

use std::{
    collections::BTreeMap,
    sync::{Arc, Condvar, Mutex, PoisonError},
    thread::JoinHandle,
    time::{Duration, Instant},
};

use flockeye_contract::wire::{all_alive_key, all_frames_key, frame_key};
use flockeye_identity::{Challenge, Statement, Trust, Untrusted, new_challenge};
use flockeye_runtime::logs::Throttle;
use zenoh::{
    Session, Wait,
    bytes::ZBytes,
    qos::{CongestionControl, Priority},
    query::{ConsolidationMode, QueryTarget, Reply},
    sample::{Sample, SampleKind},
};

use crate::connection::{Connection, spawn};
use crate::error::NetworkError;
use crate::freshness::ClockReading;
use crate::peers::{Arrival, Delivery, Peers, alive_in, observer_in};
use crate::refusal::Refusal;
use crate::stream::{ReportStream, Streams, TimedSighting};
use flockeye_runtime::clock::utc_s;
use flockeye_runtime::lock::lock;

/// Timeout of a query for an observer's last values; it publishes new ones long before.
const ANSWER_WITHIN: Duration = Duration::from_secs(2);

/// Minimum time between two queries to one observer.
const ASK_AGAIN: Duration = Duration::from_millis(500);

/// Maximum pairs of observer and reason with a throttle of their own.
const MOST_WARNINGS: usize = 256;

/// Keeps a table of the drones that are alive and their sightings, until dropped.
///
/// Frame reports are received as they are published. A new observer is queried for its last values.
/// So a drone that joins late has the same data as the others. Refused messages are counted and
/// logged, and have no other effect.
#[derive(Debug)]
pub struct Listener {
    hub: Arc<Hub>,
    thread: Option<JoinHandle<()>>,
}

impl Listener {
    pub(crate) fn start(
        connection: Arc<Connection>,
        swarm: &str,
        own: Option<String>,
        trust: Option<Trust>,
    ) -> Result<Self, NetworkError> {
        let hub = Arc::new(Hub {
            swarm: swarm.into(),
            peers: Mutex::new(Peers::of(own, trust.is_some())),
            trust,
            streams: Streams::default(),
            newcomers: Mutex::default(),
            changed: Condvar::new(),
            warnings: Mutex::default(),
        });
        let background = hub.clone();
        let thread = spawn("zenoh-listener", move || run(&background, &connection))?;
        Ok(Self { hub, thread: Some(thread) })
    }

    /// A copy of the current table.
    pub fn snapshot(&self) -> Peers {
        lock(&self.hub.peers).clone()
    }

    /// A stream of every report from now on. At most `capacity` reports wait to be read; then the
    /// oldest are dropped.
    pub fn stream(&self, capacity: usize) -> Arc<ReportStream> {
        self.hub.streams.subscribe(capacity)
    }
}

impl Drop for Listener {
    fn drop(&mut self) {
        lock(&self.hub.newcomers).closed = true;
        self.hub.changed.notify_all();
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::error!("the listener's thread panicked");
        }
    }
}

/// State that Zenoh's callbacks and the thread share.
#[derive(Debug)]
struct Hub {
    swarm: String,
    /// The members whose signatures count; none: unsigned reports of any origin are accepted.
    trust: Option<Trust>,
    peers: Mutex<Peers>,
    streams: Streams,
    newcomers: Mutex<Newcomers>,
    changed: Condvar,
    /// Throttles of warnings about refused messages: one for each observer and reason, so that none
    /// hides another.
    warnings: Mutex<BTreeMap<(String, &'static str), Throttle>>,
}

/// Observers that are still to be queried for their last values, and when. All are in the table of
/// peers, which bounds their number.
#[derive(Debug, Default)]
struct Newcomers {
    due: BTreeMap<String, Instant>,
    /// Time of the last query to each observer.
    asked: BTreeMap<String, Instant>,
    closed: bool,
}

impl Hub {
    /// Takes a message; `challenge` is that of the query which it answers.
    fn hear(&self, sample: &Sample, delivery: Delivery, challenge: Challenge) {
        if sample.kind() != SampleKind::Put {
            return;
        }
        let key = sample.key_expr().as_str();
        let arrival = Arrival { at: Instant::now(), time: ClockReading::now(), delivery };
        // Its length is limited by the session's filter.
        let payload = sample.payload().to_bytes();
        let said = Statement { key, challenge, payload: &payload };
        if let Err(refusal) = self.check(&said, sample.attachment(), &arrival) {
            return self.refused(key, &refusal);
        }
        let mut peers = lock(&self.peers);
        let taken = peers.take(key, &payload, arrival);
        let utc_less_monotonic_ns = arrival.time.utc_less_monotonic_ns();
        let sightings = match taken {
            Ok(sightings) => sightings,
            Err(refusal) => {
                drop(peers);
                return self.refused(key, &refusal);
            }
        };
        let clock = sightings.first().and_then(|first| {
            peers.observers.get(&first.observer).and_then(|peer| peer.clock(utc_less_monotonic_ns))
        });
        drop(peers);
        let arrived_monotonic_ns = arrival.time.monotonic_ns;
        for report in sightings {
            // Before the first published report the sender's clock is unknown, so the reported
            // latency counts.
            let (exposure_monotonic_ns, exposure_deviation_ns) = match clock {
                Some(clock) => (clock.monotonic_from_utc(report.stamp_utc_ns), clock.deviation_ns),
                None => {
                    let latency_ns = (report.latency_ms * 1e6) as i64;
                    (arrived_monotonic_ns.saturating_sub(latency_ns), UNKNOWN_DEVIATION_NS)
                }
            };
            self.streams.send(&TimedSighting {
                arrived_monotonic_ns,
                exposure_monotonic_ns,
                exposure_deviation_ns,
                report,
            });
        }
    }

    /// Refuses a message that the observer in its key has not signed.
    fn check(
        &self,
        said: &Statement<'_>,
        attachment: Option<&ZBytes>,
        arrival: &Arrival,
    ) -> Result<(), Refusal> {
        let (Some(trust), Some(observer)) = (&self.trust, observer_in(said.key)) else {
            // A key without an observer is refused later.
            return Ok(());
        };
        let attachment = attachment.map(ZBytes::to_bytes);
        let checked = trust.check(observer, said, attachment.as_deref(), utc_s());
        checked.map_err(|untrusted| {
            let mut peers = lock(&self.peers);
            if trust.knows(observer) {
                return peers.refuse(observer, untrusted, arrival);
            }
            // Only members have entries in the table.
            peers.refused += 1;
            match untrusted {
                Untrusted::NotKnown => Untrusted::NotAMember(observer.into()).into(),
                other => other.into(),
            }
        })
    }

    fn refused(&self, key: &str, refusal: &Refusal) {
        if matches!(refusal, Refusal::NotYetAnswered | Refusal::NotAnswered)
            && let Some(observer) = observer_in(key)
        {
            self.ask_again(observer);
        }
        if !refusal.is_usual() {
            self.warn(key, refusal);
        }
    }

    /// Schedules a query to an observer: for its last values, and as a proof of presence. It waits
    /// if the last query was just now.
    fn ask_again(&self, observer: &str) {
        let now = Instant::now();
        let mut newcomers = lock(&self.newcomers);
        let at = newcomers.asked.get(observer).map_or(now, |asked| now.max(*asked + ASK_AGAIN));
        newcomers.due.entry(observer.into()).or_insert(at);
        self.changed.notify_all();
    }

    fn warn(&self, key: &str, refusal: &Refusal) {
        let observer = observer_in(key).filter(|observer| self.may_be(observer));
        // The lock is released before logging, because a blocked log must not delay other threads.
        let mut warnings = lock(&self.warnings);
        let has_room = warnings.len() < MOST_WARNINGS;
        let name = observer.filter(|_| has_room).unwrap_or_default();
        let admitted = warnings.entry((name.into(), refusal.reason())).or_default().admit();
        drop(warnings);
        if let Some(held_back) = admitted {
            tracing::warn!(held_back, "refused a message on {key:?}: {refusal}");
        }
    }

    fn see(&self, token: &Sample) {
        let key = token.key_expr().as_str();
        let is_there = token.kind() == SampleKind::Put;
        let now = Instant::now();
        let Some(observer) = alive_in(key) else {
            lock(&self.peers).refused += 1;
            return self.warn(key, &Refusal::Key);
        };
        if !self.may_be(observer) {
            lock(&self.peers).refused += 1;
            return self.warn(key, &Untrusted::NotAMember(observer.into()).into());
        }
        if !lock(&self.peers).set_alive(observer, is_there, now) {
            return self.warn(key, &Refusal::TooManyObservers);
        }
        let mut newcomers = lock(&self.newcomers);
        if is_there {
            newcomers.due.insert(observer.into(), now);
            self.changed.notify_all();
        } else {
            newcomers.due.remove(observer);
        }
    }

    /// Whether an observer of this name is admitted.
    fn may_be(&self, observer: &str) -> bool {
        self.trust.as_ref().is_none_or(|trust| trust.knows(observer))
    }

    /// Waits for the next observer to query; none when the listener is being dropped.
    fn next(&self) -> Option<String> {
        let mut newcomers = lock(&self.newcomers);
        loop {
            if newcomers.closed {
                return None;
            }
            let now = Instant::now();
            let due = newcomers.due.iter().min_by_key(|(_, at)| **at);
            let due = due.map(|(observer, at)| (observer.clone(), *at));
            newcomers = match due {
                Some((observer, at)) if at <= now => {
                    newcomers.due.remove(&observer);
                    newcomers.asked.insert(observer.clone(), now);
                    return Some(observer);
                }
                Some((_, at)) => {
                    self.changed
                        .wait_timeout(newcomers, at - now)
                        .unwrap_or_else(PoisonError::into_inner)
                        .0
                }
                None => self.changed.wait(newcomers).unwrap_or_else(PoisonError::into_inner),
            };
        }
    }
}

/// Standard deviation of an exposure time before the sender's clock is known: a typical transit
/// time.
const UNKNOWN_DEVIATION_NS: i64 = 10_000_000;

fn run(hub: &Arc<Hub>, connection: &Connection) {
    if let Some(session) = connection.session(|| lock(&hub.newcomers).closed)
        && let Err(error) = listen(hub, &session)
    {
        tracing::error!("the other drones cannot be heard: {error}");
    }
    hub.streams.close();
}

fn listen(hub: &Arc<Hub>, session: &Session) -> zenoh::Result<()> {
    let subscriber = session.declare_subscriber(all_frames_key(&hub.swarm));
    let published = {
        let hub = hub.clone();
        move |sample: Sample| hub.hear(&sample, Delivery::Published, Challenge::default())
    };
    let _frames = subscriber.callback(published).wait()?;
    let tokens = session.liveliness().declare_subscriber(all_alive_key(&hub.swarm));
    let token = {
        let hub = hub.clone();
        move |token: Sample| hub.see(&token)
    };
    let _alive = tokens.history(true).callback(token).wait()?;
    while let Some(observer) = hub.next() {
        ask(hub, session, observer)?;
    }
    Ok(())
}

/// An observer that was queried. It counts as heard once this is dropped with the query's callback.
struct Question {
    hub: Arc<Hub>,
    observer: String,
}

impl Drop for Question {
    fn drop(&mut self) {
        lock(&self.hub.peers).set_heard(&self.observer);
    }
}

/// Queries `observer` for its last values, without waiting for the answer.
fn ask(hub: &Arc<Hub>, session: &Session, observer: String) -> zenoh::Result<()> {
    let key = frame_key(&hub.swarm, &observer);
    let asked = Question { hub: hub.clone(), observer };
    let challenge = new_challenge().ok_or("the system has no random bytes")?;
    session
        .get(key)
        .attachment(challenge)
        .target(QueryTarget::All)
        .consolidation(ConsolidationMode::None)
        .congestion_control(CongestionControl::Drop)
        .priority(Priority::RealTime)
        .timeout(ANSWER_WITHIN)
        .callback(move |reply: Reply| {
            // An error is a timeout or an observer without an answer; its next reports arrive
            // anyway.
            if let Ok(sample) = reply.result() {
                asked.hub.hear(sample, Delivery::LastValue, challenge);
            }
        })
        .wait()
}
