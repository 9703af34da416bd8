//! Publishes where this drone sees its neighbours.

use std::{
    collections::{BTreeMap, btree_map::Entry},
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering::Relaxed},
    },
    thread::{self, JoinHandle},
    time::{Duration, Instant},
};

use flockeye_contract::wire::{
    FrameReport, PoseReport, WireError, alive_key, frames_token_key, is_name,
};
use flockeye_identity::{Challenge, Member, Said};
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
use crate::outbox::{Held, Outbox, Outgoing, Slot};

/// So often the certificate goes along with a signature.
const CERTIFICATE_PERIOD: Duration = Duration::from_secs(1);

/// Publishes that this drone is alive and where it sees its neighbours, until dropped.
///
/// [`report`](Self::report) puts a report into a slot and returns; a separate thread hands it to Zenoh.
/// So a stalled network never blocks the caller: waiting reports are replaced by newer ones.
#[derive(Debug)]
pub struct Reporter {
    observer: String,
    outbox: Arc<Outbox>,
    counts: Arc<Counts>,
    thread: Option<JoinHandle<()>>,
}

/// How many reports were sent, replaced and refused.
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
        member: Option<Arc<Member>>,
    ) -> Result<Self, NetworkError> {
        let (outbox, counts) = (Arc::new(Outbox::default()), Arc::new(Counts::default()));
        let sender = Sender {
            swarm: swarm.into(),
            observer: observer.into(),
            outbox: outbox.clone(),
            counts: counts.clone(),
            member,
        };
        let name = "zenoh-reporter";
        let thread = thread::Builder::new()
            .name(name.into())
            .spawn(move || sender.run(&connection))
            .map_err(|source| NetworkError::Thread { name, source })?;
        Ok(Self { observer: observer.into(), outbox, counts, thread: Some(thread) })
    }

    /// Sends `report` as soon as the network takes it, unless a newer one on the same target comes
    /// first. Returns at once. A report of a lost track is sent too, but it does not answer later
    /// queries. One of a tentative track goes out under a key of its own.
    ///
    /// # Errors
    /// [`NetworkError::Name`], [`NetworkError::Report`] and [`NetworkError::TooManyTargets`] for a
    /// report that no listener would accept; it is counted as failed, and others are unaffected.
    pub fn report(&self, report: &PoseReport) -> Result<(), NetworkError> {
        let now = Instant::now();
        let put =
            self.check(report).and_then(|()| self.outbox.put(Outgoing::Pose(report.clone()), now));
        self.counted(put)
    }

    /// Sends `report` as soon as the network takes it, unless a newer one comes first. Returns at once.
    ///
    /// # Errors
    /// As those of [`report`](Self::report).
    pub fn report_frame(&self, report: FrameReport) -> Result<(), NetworkError> {
        let now = Instant::now();
        let put =
            self.check_frame(&report).and_then(|()| self.outbox.put(Outgoing::Frame(report), now));
        self.counted(put)
    }

    fn counted(&self, put: Result<(), NetworkError>) -> Result<(), NetworkError> {
        if put.is_err() {
            self.counts.failed.fetch_add(1, Relaxed);
        }
        put
    }

    /// How many reports were sent, replaced and refused.
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
        self.check_observer(&report.observer, &report.target)?;
        if !is_name(&report.target) {
            let reason = "is no name of letters, digits, '-', '_' or '.'".into();
            return Err(NetworkError::Name { target: target(), reason });
        }
        let read_back = |json: Vec<u8>| PoseReport::from_json(&json).map(drop);
        let checked: Result<(), WireError> = report.to_json().and_then(read_back);
        checked.map_err(|source| NetworkError::Report { target: target(), source })
    }

    fn check_frame(&self, report: &FrameReport) -> Result<(), NetworkError> {
        self.check_observer(&report.observer, "all")?;
        let read_back = |json: Vec<u8>| FrameReport::from_json(&json).map(drop);
        let checked: Result<(), WireError> = report.to_json().and_then(read_back);
        checked.map_err(|source| NetworkError::Report { target: "all".into(), source })
    }

    fn check_observer(&self, observer: &str, target: &str) -> Result<(), NetworkError> {
        if observer == self.observer {
            return Ok(());
        }
        let reason = format!("in the name of '{observer}', not '{}'", self.observer);
        Err(NetworkError::Name { target: target.into(), reason })
    }
}

impl Drop for Reporter {
    /// Sends what is waiting, then withdraws the liveliness token. On a stalled link this may take two
    /// seconds, after which Zenoh closes the link.
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
    member: Option<Arc<Member>>,
}

/// Where reports of one kind go out, and when the certificate went along last.
struct Way {
    publisher: Publisher<'static>,
    certificate_sent: Option<Instant>,
}

impl Way {
    /// Whether it is time for the certificate.
    fn needs_certificate(&mut self, now: Instant) -> bool {
        let is_due = self.certificate_sent.is_none_or(|sent| now - sent >= CERTIFICATE_PERIOD);
        if is_due {
            self.certificate_sent = Some(now);
        }
        is_due
    }
}

impl Sender {
    fn run(&self, connection: &Connection) {
        let Some(session) = connection.session(|| self.outbox.is_closed()) else { return };
        if let Err(error) = self.serve(&session) {
            tracing::error!("reports no longer reach the network: {error}");
        }
        // From here on errors are returned to the caller.
        self.outbox.close();
    }

    fn serve(&self, session: &Session) -> zenoh::Result<()> {
        // Drones that join later query when they see the token, so the queryable is declared first.
        let answerer = Answerer {
            swarm: self.swarm.clone(),
            observer: self.observer.clone(),
            outbox: self.outbox.clone(),
            member: self.member.clone(),
        };
        let _last_values = session
            .declare_queryable(format!("flockeye/{}/{}/sees/**", self.swarm, self.observer))
            .callback(move |query| answerer.answer(&query))
            .wait()?;
        let liveliness = session.liveliness();
        // Before the other: whoever sees that, and not this, listens to each pose.
        let _frames =
            liveliness.declare_token(frames_token_key(&self.swarm, &self.observer)).wait()?;
        let _alive = liveliness.declare_token(alive_key(&self.swarm, &self.observer)).wait()?;

        let mut ways = BTreeMap::new();
        let mut warnings = Throttle::default();
        while let Some((slot, held)) = self.outbox.take() {
            match self.send(session, &mut ways, &slot, &held) {
                Ok(()) => self.counts.sent.fetch_add(1, Relaxed),
                Err(error) => {
                    if let Some(held_back) = warnings.admit() {
                        let key = slot.key(&self.swarm, &self.observer);
                        tracing::warn!(held_back, "a report on {key} was not sent: {error}");
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
        ways: &mut BTreeMap<Slot, Way>,
        slot: &Slot,
        held: &Held,
    ) -> zenoh::Result<()> {
        let way = match ways.entry(slot.clone()) {
            Entry::Occupied(known) => known.into_mut(),
            Entry::Vacant(new) => new.insert(Way {
                publisher: session
                    .declare_publisher(slot.key(&self.swarm, &self.observer))
                    .encoding(Encoding::APPLICATION_JSON)
                    .congestion_control(CongestionControl::Drop)
                    .priority(Priority::RealTime)
                    .express(true)
                    .reliability(Reliability::BestEffort)
                    .wait()?,
                certificate_sent: None,
            }),
        };
        let now = Instant::now();
        let payload = held.encode(now)?;
        let seal = self.member.as_ref().map(|member| {
            let with_certificate = way.needs_certificate(now);
            let key = way.publisher.key_expr().as_str();
            let said = Said { key, challenge: Challenge::default(), payload: &payload };
            member.seal(&said, with_certificate)
        });
        way.publisher.put(payload).attachment(seal).wait()
    }
}

/// Answers queries with the last values.
struct Answerer {
    swarm: String,
    observer: String,
    outbox: Arc<Outbox>,
    member: Option<Arc<Member>>,
}

impl Answerer {
    /// Answers with the last value of every key that is asked for.
    fn answer(&self, query: &Query) {
        for (slot, held) in self.outbox.last_values() {
            let key = slot.key(&self.swarm, &self.observer);
            let Ok(key) = zenoh::key_expr::KeyExpr::try_from(key) else { continue };
            if !query.key_expr().intersects(&key) {
                continue;
            }
            let sent = held.encode(Instant::now()).map_err(zenoh::Error::from).and_then(|json| {
                let seal =
                    self.member.as_ref().zip(challenge_in(query)).map(|(member, challenge)| {
                        member.seal(&Said { key: &key, challenge, payload: &json }, true)
                    });
                query.reply(&key, json).encoding(Encoding::APPLICATION_JSON).attachment(seal).wait()
            });
            if let Err(error) = sent {
                // The asking drone has left or asks again; nothing here depends on the answer.
                tracing::debug!("a query for {key} was not answered: {error}");
            }
        }
    }
}

/// What the answer is signed for. Without a challenge, or for that of what is published, it is not signed: somebody
/// could pass it on as a publication.
fn challenge_in(query: &Query) -> Option<Challenge> {
    let challenge = Challenge::try_from(&*query.attachment()?.to_bytes()).ok()?;
    (challenge != Challenge::default()).then_some(challenge)
}
