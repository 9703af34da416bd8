//! Hears what the others say.

use std::{
    collections::BTreeSet,
    sync::{Arc, Condvar, Mutex, PoisonError},
    thread::{self, JoinHandle},
    time::{Duration, Instant},
};

use flockeye_contract::wire::{
    MAX_REPORT_BYTES, WireError, all_alive_key, all_poses_key, pose_key,
};
use flockeye_runtime::clock::monotonic_ns;
use flockeye_runtime::logs::Throttle;
use zenoh::{
    Session, Wait,
    bytes::ZBytes,
    qos::{CongestionControl, Priority},
    query::{ConsolidationMode, QueryTarget, Reply},
    sample::{Sample, SampleKind},
};

use crate::connection::Connection;
use crate::error::NetworkError;
use crate::lock::lock;
use crate::peers::{Arrival, Peers, Refusal, Way, observer_in};
use crate::stream::{Heard, ReportStream, Streams};

/// How long an observer has for its last values; it publishes anew long before.
const ANSWER_WITHIN: Duration = Duration::from_secs(2);

/// Keeps a table of who is alive and what each of them sees, until dropped.
///
/// Reports come in as they are published; whoever was there before is asked for its last values
/// when it is first seen, so that a latecomer knows what the others do. Whatever is refused is
/// counted and warned of, and touches nothing else.
#[derive(Debug)]
pub struct Listener {
    hearing: Arc<Hearing>,
    thread: Option<JoinHandle<()>>,
}

impl Listener {
    pub(crate) fn start(connection: Arc<Connection>, swarm: &str) -> Result<Self, NetworkError> {
        let hearing = Arc::new(Hearing {
            swarm: swarm.into(),
            peers: Mutex::default(),
            streams: Streams::default(),
            newcomers: Mutex::default(),
            changed: Condvar::new(),
            warnings: Mutex::default(),
        });
        let name = "zenoh-listener";
        let thread = {
            let hearing = hearing.clone();
            thread::Builder::new()
                .name(name.into())
                .spawn(move || run(&hearing, &connection))
                .map_err(|source| NetworkError::Thread { name, source })?
        };
        Ok(Self { hearing, thread: Some(thread) })
    }

    /// What is known now.
    pub fn snapshot(&self) -> Peers {
        lock(&self.hearing.peers).clone()
    }

    /// Every report from now on, one by one; at most `capacity` wait to be read, then the oldest
    /// are dropped.
    pub fn stream(&self, capacity: usize) -> ReportStream {
        self.hearing.streams.subscribe(capacity)
    }
}

impl Drop for Listener {
    fn drop(&mut self) {
        lock(&self.hearing.newcomers).closed = true;
        self.hearing.changed.notify_all();
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::error!("the listener's thread panicked");
        }
    }
}

/// What Zenoh's callbacks and the thread share.
#[derive(Debug)]
struct Hearing {
    swarm: String,
    peers: Mutex<Peers>,
    streams: Streams,
    newcomers: Mutex<Newcomers>,
    changed: Condvar,
    warnings: Mutex<Throttle>,
}

/// Observers to ask for their last values. They all stand in the table of peers, so there are no
/// more than that holds.
#[derive(Debug, Default)]
struct Newcomers {
    observers: BTreeSet<String>,
    closed: bool,
}

impl Hearing {
    fn hear(&self, key: &str, payload: &ZBytes, way: Way) {
        let arrival = Arrival { at: Instant::now(), monotonic_ns: monotonic_ns(), way };
        // Read no more of it than shows that it is too long.
        let readable = payload.len() <= MAX_REPORT_BYTES;
        let payload_bytes = if readable { payload.to_bytes() } else { Default::default() };
        let taken = lock(&self.peers).take(key, &payload_bytes, arrival);
        match taken {
            Ok(Some(report)) => {
                let arrived_monotonic_ns = arrival.monotonic_ns;
                self.streams.send(&Heard { arrived_monotonic_ns, report });
            }
            Ok(None) => {}
            Err(_) if !readable => {
                self.warn(key, &WireError::TooLong { found: payload.len() }.into());
            }
            Err(refusal) => self.warn(key, &refusal),
        }
    }

    fn warn(&self, key: &str, refusal: &Refusal) {
        if let Some(held_back) = lock(&self.warnings).admit() {
            tracing::warn!(held_back, "refused a message on {key:?}: {refusal}");
        }
    }

    fn see(&self, token: &Sample) {
        let key = token.key_expr().as_str();
        let Some(observer) = observer_in(key) else {
            lock(&self.peers).refused += 1;
            return self.warn(key, &Refusal::Key);
        };
        let alive = token.kind() == SampleKind::Put;
        if !lock(&self.peers).set_alive(observer, alive, Instant::now()) {
            return self.warn(key, &Refusal::TooManyObservers);
        }
        if alive {
            lock(&self.newcomers).observers.insert(observer.into());
            self.changed.notify_all();
        }
    }

    /// The next observer to ask; none when the listener is being dropped.
    fn next_newcomer(&self) -> Option<String> {
        let mut newcomers = lock(&self.newcomers);
        loop {
            if newcomers.closed {
                return None;
            }
            if let Some(observer) = newcomers.observers.pop_first() {
                return Some(observer);
            }
            newcomers = self.changed.wait(newcomers).unwrap_or_else(PoisonError::into_inner);
        }
    }
}

fn run(hearing: &Arc<Hearing>, connection: &Connection) {
    if let Some(session) = connection.session(|| lock(&hearing.newcomers).closed)
        && let Err(error) = listen(hearing, &session)
    {
        tracing::error!("the other drones cannot be heard: {error}");
    }
    hearing.streams.close();
}

fn listen(hearing: &Arc<Hearing>, session: &Session) -> zenoh::Result<()> {
    let _poses = session
        .declare_subscriber(all_poses_key(&hearing.swarm))
        .callback({
            let hearing = hearing.clone();
            move |sample| {
                hearing.hear(sample.key_expr().as_str(), sample.payload(), Way::Published);
            }
        })
        .wait()?;
    let _tokens = session
        .liveliness()
        .declare_subscriber(all_alive_key(&hearing.swarm))
        .history(true)
        .callback({
            let hearing = hearing.clone();
            move |token| hearing.see(&token)
        })
        .wait()?;
    // Everybody, also who reports without a token; then each as its token appears.
    ask(hearing, session, "*")?;
    while let Some(observer) = hearing.next_newcomer() {
        ask(hearing, session, &observer)?;
    }
    Ok(())
}

/// Asks `observer` for its last values, without waiting for them.
fn ask(hearing: &Arc<Hearing>, session: &Session, observer: &str) -> zenoh::Result<()> {
    let hearing = hearing.clone();
    session
        .get(pose_key(&hearing.swarm, observer, "*"))
        .target(QueryTarget::All)
        .consolidation(ConsolidationMode::None)
        .congestion_control(CongestionControl::Drop)
        .priority(Priority::RealTime)
        .timeout(ANSWER_WITHIN)
        .callback(move |reply: Reply| {
            // An error is a timeout or an observer without an answer: what it publishes comes.
            if let Ok(sample) = reply.result() {
                hearing.hear(sample.key_expr().as_str(), sample.payload(), Way::LastValue);
            }
        })
        .wait()
}
