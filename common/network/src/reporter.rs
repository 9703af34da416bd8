//! Publishes this drone's sightings of its neighbours.

use std::{
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering::Relaxed},
    },
    thread::JoinHandle,
    time::{Duration, Instant},
};

use flockeye_contract::wire::{FrameReport, alive_key, frame_key};
use flockeye_identity::{Challenge, Member, Statement};
use flockeye_runtime::logs::Throttle;
use zenoh::{
    Session, Wait,
    bytes::Encoding,
    pubsub::Publisher,
    qos::{CongestionControl, Priority, Reliability},
    query::Query,
};

use crate::connection::{Connection, spawn};
use crate::error::NetworkError;
use crate::outbox::{Outbox, QueuedReport};

/// Time between two signatures that carry the certificate.
const CERTIFICATE_PERIOD: Duration = Duration::from_secs(1);

/// Publishes that this drone is alive, and its sightings of neighbours, until dropped.
///
/// [`report`](Self::report) queues a report and returns; a separate thread passes it to Zenoh. So a
/// blocked network never blocks the caller: a newer report replaces one that waits.
#[derive(Debug)]
pub struct Reporter {
    publication: Arc<Publication>,
    thread: Option<JoinHandle<()>>,
}

/// Numbers of messages that were sent, replaced and refused.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct SendCounters {
    /// Passed to Zenoh, which may still drop them on a congested link.
    pub sent: u64,
    /// Replaced by a newer message before they were sent.
    pub overwritten: u64,
    /// Refused here or by Zenoh.
    pub failed: u64,
}

/// State that the caller, the sending thread and the answers to queries share.
#[derive(Debug)]
struct Publication {
    swarm: String,
    observer: String,
    outbox: Outbox,
    member: Option<Arc<Member>>,
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
        let publication = Arc::new(Publication {
            swarm: swarm.into(),
            observer: observer.into(),
            outbox: Outbox::default(),
            member,
            sent: AtomicU64::new(0),
            failed: AtomicU64::new(0),
        });
        let sender = publication.clone();
        let thread = spawn("zenoh-reporter", move || sender.run(&connection))?;
        Ok(Self { publication, thread: Some(thread) })
    }

    /// Sends `report` as soon as the network accepts it, unless a newer one comes first. Returns at
    /// once. Its lost targets are sent too, but are not part of answers to later queries.
    ///
    /// # Errors
    /// [`NetworkError::Name`], [`NetworkError::Report`] and [`NetworkError::TooManyTargets`] for a
    /// report that no listener would accept. It is counted as failed, and later ones are
    /// unaffected.
    pub fn report(&self, report: FrameReport) -> Result<(), NetworkError> {
        let checked = self.publication.check(&report);
        let put = checked.and_then(|()| self.publication.outbox.put(report, Instant::now()));
        if put.is_err() {
            self.publication.failed.fetch_add(1, Relaxed);
        }
        put
    }

    /// Numbers of reports that were sent, replaced and refused.
    pub fn counters(&self) -> SendCounters {
        SendCounters {
            sent: self.publication.sent.load(Relaxed),
            overwritten: self.publication.outbox.overwritten(),
            failed: self.publication.failed.load(Relaxed),
        }
    }
}

impl Drop for Reporter {
    /// Sends the waiting report, then withdraws the liveliness token. On a blocked link this may
    /// take two seconds, after which Zenoh closes the link.
    fn drop(&mut self) {
        self.publication.outbox.close();
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::error!("the reporter's thread panicked");
        }
    }
}

impl Publication {
    /// Refuses a report that a listener would refuse.
    fn check(&self, report: &FrameReport) -> Result<(), NetworkError> {
        if report.observer != self.observer {
            let (found, own) = (report.observer.clone(), self.observer.clone());
            return Err(NetworkError::Name { found, own });
        }
        let json = report.to_json().map_err(NetworkError::Report)?;
        FrameReport::from_json(&json).map(drop).map_err(NetworkError::Report)
    }

    fn run(self: &Arc<Self>, connection: &Connection) {
        let Some(session) = connection.session(|| self.outbox.is_closed()) else { return };
        if let Err(error) = self.serve(&session) {
            tracing::error!("reports no longer reach the network: {error}");
        }
        // The closed outbox returns errors to the caller from now on.
        self.outbox.close();
    }

    fn serve(self: &Arc<Self>, session: &Session) -> zenoh::Result<()> {
        let key = frame_key(&self.swarm, &self.observer);
        // Drones that join later send a query when they receive the token, so the queryable is
        // declared first.
        let answerer = self.clone();
        let _last_value = session
            .declare_queryable(key.as_str())
            .callback(move |query| answerer.answer(&query))
            .wait()?;
        let token = alive_key(&self.swarm, &self.observer);
        let _alive = session.liveliness().declare_token(token).wait()?;
        let publisher = session
            .declare_publisher(key.clone())
            .encoding(Encoding::APPLICATION_JSON)
            .congestion_control(CongestionControl::Drop)
            .priority(Priority::RealTime)
            .express(true)
            .reliability(Reliability::BestEffort)
            .wait()?;
        let mut certificate_sent = None;
        let mut warnings = Throttle::default();
        while let Some(report) = self.outbox.take() {
            match self.send(&publisher, &report, &mut certificate_sent) {
                Ok(()) => self.sent.fetch_add(1, Relaxed),
                Err(error) => {
                    if let Some(held_back) = warnings.admit() {
                        tracing::warn!(held_back, "a report on {key} was not sent: {error}");
                    }
                    self.failed.fetch_add(1, Relaxed)
                }
            };
        }
        Ok(())
    }

    /// Sends a report, with the certificate once per period.
    fn send(
        &self,
        publisher: &Publisher<'_>,
        report: &QueuedReport,
        certificate_sent: &mut Option<Instant>,
    ) -> zenoh::Result<()> {
        let now = Instant::now();
        let payload = report.encode(now)?;
        let seal = self.member.as_ref().map(|member| {
            let with_certificate =
                certificate_sent.is_none_or(|sent| now - sent >= CERTIFICATE_PERIOD);
            if with_certificate {
                *certificate_sent = Some(now);
            }
            let key = publisher.key_expr().as_str();
            let said = Statement { key, challenge: Challenge::default(), payload: &payload };
            member.seal(&said, with_certificate)
        });
        publisher.put(payload).attachment(seal).wait()
    }

    /// Answers a query with the last report.
    fn answer(&self, query: &Query) {
        let Some(report) = self.outbox.last_value() else { return };
        let key = frame_key(&self.swarm, &self.observer);
        let key = key.as_str();
        let sent = report.encode(Instant::now()).map_err(zenoh::Error::from).and_then(|json| {
            let seal: Option<Vec<u8>> =
                self.member.as_ref().zip(challenge_in(query)).map(|(member, challenge)| {
                    member.seal(&Statement { key, challenge, payload: &json }, true)
                });
            query.reply(key, json).encoding(Encoding::APPLICATION_JSON).attachment(seal).wait()
        });
        if let Err(error) = sent {
            // The drone has left or will repeat the query; nothing here depends on the answer.
            tracing::debug!("a query for {key} was not answered: {error}");
        }
    }
}

/// The challenge for which the answer is signed. An answer without one, or with that of published
/// reports, is not signed: an attacker could pass it on as a publication.
fn challenge_in(query: &Query) -> Option<Challenge> {
    let challenge = Challenge::try_from(&*query.attachment()?.to_bytes()).ok()?;
    (challenge != Challenge::default()).then_some(challenge)
}
