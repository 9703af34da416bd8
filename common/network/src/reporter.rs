//! Says where this drone sees whom.

use std::{
    collections::{BTreeMap, btree_map::Entry},
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering::Relaxed},
    },
    thread::{self, JoinHandle},
    time::Instant,
};

use flockeye_contract::wire::{PoseReport, WireError, alive_key, is_name, pose_key};
use flockeye_runtime::logs::Throttle;
use zenoh::{
    Session, Wait,
    bytes::Encoding,
    pubsub::Publisher,
    qos::{CongestionControl, Priority, Reliability},
    query::Query,
};

use crate::connection::Connection;
use crate::error::NetworkError;
use crate::outbox::{Held, Outbox};

/// Says that this drone is alive, and where it sees whom, until dropped.
///
/// [`report`](Self::report) puts a report into a slot and returns; a thread of its own takes it to
/// Zenoh. So a stalled network cannot touch whoever calls it: reports are replaced by newer ones.
#[derive(Debug)]
pub struct Reporter {
    observer: String,
    outbox: Arc<Outbox>,
    counts: Arc<Counts>,
    thread: Option<JoinHandle<()>>,
}

/// What became of the reports so far.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ReporterCounters {
    /// Handed to Zenoh, which may still drop them on a congested link.
    pub sent: u64,
    /// Replaced by a newer report on the same target before they were sent.
    pub overwritten: u64,
    /// Refused by [`Reporter::report`] or by Zenoh.
    pub failed: u64,
}

#[derive(Debug, Default)]
struct Counts {
    sent: AtomicU64,
    failed: AtomicU64,
}

impl Reporter {
    pub(crate) fn start(
        connection: Arc<Connection>,
        swarm: &str,
        observer: &str,
    ) -> Result<Self, NetworkError> {
        let (outbox, counts) = (Arc::new(Outbox::default()), Arc::new(Counts::default()));
        let sender = Sender {
            swarm: swarm.into(),
            observer: observer.into(),
            outbox: outbox.clone(),
            counts: counts.clone(),
        };
        let name = "zenoh-reporter";
        let thread = thread::Builder::new()
            .name(name.into())
            .spawn(move || sender.run(&connection))
            .map_err(|source| NetworkError::Thread { name, source })?;
        Ok(Self { observer: observer.into(), outbox, counts, thread: Some(thread) })
    }

    /// Sends `report` as soon as the network takes it, unless a newer one on the same target comes
    /// first. Returns at once. A report of a lost track is sent, and then no longer answers the
    /// queries of latecomers.
    ///
    /// # Errors
    /// [`NetworkError::Name`], [`NetworkError::Report`] and [`NetworkError::TooManyTargets`] for a
    /// report that no listener would accept; it is counted as failed, and others are unaffected.
    pub fn report(&self, report: &PoseReport) -> Result<(), NetworkError> {
        let now = Instant::now();
        let put = self.check(report).and_then(|()| self.outbox.put(report, now));
        if put.is_err() {
            self.counts.failed.fetch_add(1, Relaxed);
        }
        put
    }

    /// What became of the reports so far.
    pub fn counters(&self) -> ReporterCounters {
        ReporterCounters {
            sent: self.counts.sent.load(Relaxed),
            overwritten: self.outbox.overwritten(),
            failed: self.counts.failed.load(Relaxed),
        }
    }

    /// Refuses what a listener would.
    fn check(&self, report: &PoseReport) -> Result<(), NetworkError> {
        let target = || report.target.clone();
        if report.observer != self.observer {
            let reason = format!("in the name of '{}', not '{}'", report.observer, self.observer);
            return Err(NetworkError::Name { target: target(), reason });
        }
        if !is_name(&report.target) {
            let reason = "is no name of letters, digits, '-', '_' or '.'".into();
            return Err(NetworkError::Name { target: target(), reason });
        }
        let read_back = |json: Vec<u8>| PoseReport::from_json(&json).map(drop);
        let checked: Result<(), WireError> = report.to_json().and_then(read_back);
        checked.map_err(|source| NetworkError::Report { target: target(), source })
    }
}

impl Drop for Reporter {
    /// Sends what is waiting, then says that this drone is gone. On a stalled link this may take
    /// the two seconds after which Zenoh gives the link up.
    fn drop(&mut self) {
        self.outbox.close();
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::error!("the reporter's thread panicked");
        }
    }
}

/// The thread's side.
struct Sender {
    swarm: String,
    observer: String,
    outbox: Arc<Outbox>,
    counts: Arc<Counts>,
}

impl Sender {
    fn run(&self, connection: &Connection) {
        let Some(session) = connection.session(|| self.outbox.is_closed()) else { return };
        if let Err(error) = self.serve(&session) {
            tracing::error!("reports no longer reach the network: {error}");
        }
        // From here on the caller is told.
        self.outbox.close();
    }

    fn serve(&self, session: &Session) -> zenoh::Result<()> {
        // Latecomers ask when they see the token, so what answers them stands first.
        let outbox = self.outbox.clone();
        let _last_values = session
            .declare_queryable(pose_key(&self.swarm, &self.observer, "*"))
            .callback({
                let (swarm, observer) = (self.swarm.clone(), self.observer.clone());
                move |query| answer(&query, &outbox, &swarm, &observer)
            })
            .wait()?;
        let _alive =
            session.liveliness().declare_token(alive_key(&self.swarm, &self.observer)).wait()?;

        let mut publishers = BTreeMap::new();
        let mut warnings = Throttle::default();
        while let Some(held) = self.outbox.take() {
            match self.send(session, &mut publishers, &held) {
                Ok(()) => self.counts.sent.fetch_add(1, Relaxed),
                Err(error) => {
                    if let Some(held_back) = warnings.admit() {
                        let target = &held.report.target;
                        tracing::warn!(held_back, "the report on '{target}' was not sent: {error}");
                    }
                    self.counts.failed.fetch_add(1, Relaxed)
                }
            };
        }
        Ok(())
    }

    fn send(
        &self,
        session: &Session,
        publishers: &mut BTreeMap<String, Publisher<'static>>,
        held: &Held,
    ) -> zenoh::Result<()> {
        let target = &held.report.target;
        let publisher = match publishers.entry(target.clone()) {
            Entry::Occupied(known) => known.into_mut(),
            Entry::Vacant(new) => new.insert(
                session
                    .declare_publisher(pose_key(&self.swarm, &self.observer, target))
                    .encoding(Encoding::APPLICATION_JSON)
                    .congestion_control(CongestionControl::Drop)
                    .priority(Priority::RealTime)
                    .express(true)
                    .reliability(Reliability::BestEffort)
                    .wait()?,
            ),
        };
        publisher.put(held.encode(Instant::now())?).wait()
    }
}

/// Answers a latecomer with the last value of every target it asks for.
fn answer(query: &Query, outbox: &Outbox, swarm: &str, observer: &str) {
    for held in outbox.last_values() {
        let key = pose_key(swarm, observer, &held.report.target);
        let Ok(key) = zenoh::key_expr::KeyExpr::try_from(key) else { continue };
        if !query.key_expr().intersects(&key) {
            continue;
        }
        let sent = held
            .encode(Instant::now())
            .map_err(zenoh::Error::from)
            .and_then(|json| query.reply(&key, json).encoding(Encoding::APPLICATION_JSON).wait());
        if let Err(error) = sent {
            // Who asked has gone, or asks again; nothing here depends on it.
            tracing::debug!("a query for {key} was not answered: {error}");
        }
    }
}
