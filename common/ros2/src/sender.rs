//! The thread that opens the session and hands messages to Zenoh.

use std::{
    collections::{BTreeMap, btree_map::Entry},
    mem::discriminant,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering::Relaxed, Ordering::SeqCst},
    },
    time::{Duration, SystemTime, UNIX_EPOCH},
};

use flockeye_runtime::logs::Throttle;
use flockeye_runtime::slots::Slots;
use zenoh::{
    Session, Wait,
    liveliness::LivelinessToken,
    pubsub::Publisher,
    qos::{CongestionControl, Reliability},
};

use crate::error::Ros2Error;
use crate::keys::{NodeIdentity, attachment, gid, topic_key};
use crate::messages::MessageType;
use crate::parameters::Ros2Mode;

/// How long a session that could not be opened is left alone.
const RETRY: Duration = Duration::from_secs(1);

/// A topic and what is published on it.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Topic {
    /// Its name, beginning with '/'.
    pub(crate) name: String,
    pub(crate) message: MessageType,
}

/// What the thread shares with the node.
#[derive(Debug, Default)]
pub(crate) struct Shared {
    /// CDR bytes of the newest message of each topic.
    pub(crate) outbox: Slots<Topic, Vec<u8>>,
    pub(crate) is_open: AtomicBool,
    pub(crate) sent: AtomicU64,
    pub(crate) failed: AtomicU64,
}

/// The thread's side.
pub(crate) struct Sender {
    /// Zenoh's configuration, JSON.
    pub(crate) config: String,
    pub(crate) mode: Ros2Mode,
    /// What to say of whom it looks for.
    pub(crate) whereabouts: String,
    pub(crate) domain: u32,
    /// Namespace of the node, beginning with '/'.
    pub(crate) namespace: String,
    pub(crate) shared: Arc<Shared>,
}

/// A publisher as ROS nodes see it.
struct Announced {
    publisher: Publisher<'static>,
    /// Undeclared when dropped.
    _token: LivelinessToken,
    gid: [u8; 16],
    sequence: i64,
}

impl Sender {
    pub(crate) fn run(&self) {
        let Some(session) = self.open() else { return };
        self.shared.is_open.store(true, SeqCst);
        if let Err(error) = self.serve(&session) {
            tracing::error!("nothing is published to ROS 2 any more: {error}");
        }
        // From here on errors are returned to the caller.
        self.shared.outbox.close();
    }

    /// Opens the session, however long that takes; none once the node is dropped.
    fn open(&self) -> Option<Session> {
        // Each kind of failure is said once: the second may come long after the first.
        let mut told = Vec::new();
        loop {
            match open(&self.config, self.mode) {
                Ok(session) => return Some(session),
                Err(error) => {
                    let kind = discriminant(&error);
                    if !told.contains(&kind) {
                        let whereabouts = &self.whereabouts;
                        tracing::warn!(
                            "ROS 2 is not reached {whereabouts} yet, still trying: {error}"
                        );
                        told.push(kind);
                    }
                }
            }
            if self.shared.outbox.wait_closed(RETRY) {
                return None;
            }
        }
    }

    fn serve(&self, session: &Session) -> zenoh::Result<()> {
        let node = NodeIdentity {
            domain: self.domain,
            session: session.zid().to_string(),
            namespace: self.namespace.clone(),
            name: "flockeye".into(),
        };
        let _token = session.liveliness().declare_token(node.token()).wait()?;
        let mut publishers = BTreeMap::new();
        let mut warnings = Throttle::default();
        while let Some((topic, payload)) = self.shared.outbox.take() {
            match send(session, &node, &mut publishers, &topic, payload) {
                Ok(()) => self.shared.sent.fetch_add(1, Relaxed),
                Err(error) => {
                    if let Some(held_back) = warnings.admit() {
                        let name = &topic.name;
                        tracing::warn!(held_back, "a message on {name} was not sent: {error}");
                    }
                    self.shared.failed.fetch_add(1, Relaxed)
                }
            };
        }
        Ok(())
    }
}

fn open(config: &str, mode: Ros2Mode) -> Result<Session, Ros2Error> {
    let failed =
        |what| move |error: zenoh::Error| Ros2Error::Zenoh { what, reason: error.to_string() };
    let config = zenoh::Config::from_json5(config).map_err(failed("read its configuration"))?;
    let session = zenoh::open(config).wait().map_err(failed("open a session"))?;
    if mode == Ros2Mode::Client && session.info().routers_zid().wait().next().is_none() {
        session.close().wait().map_err(failed("close a session"))?;
        return Err(Ros2Error::NoRouter);
    }
    Ok(session)
}

fn send(
    session: &Session,
    node: &NodeIdentity,
    publishers: &mut BTreeMap<Topic, Announced>,
    topic: &Topic,
    payload: Vec<u8>,
) -> zenoh::Result<()> {
    // The node's own number is 0.
    let entity = u32::try_from(publishers.len() + 1)?;
    let announced = match publishers.entry(topic.clone()) {
        Entry::Occupied(known) => known.into_mut(),
        Entry::Vacant(new) => new.insert(announce(session, node, topic, entity)?),
    };
    announced.sequence += 1;
    let sent_utc_ns = i64::try_from(SystemTime::now().duration_since(UNIX_EPOCH)?.as_nanos())?;
    let attached = attachment(announced.sequence, sent_utc_ns, announced.gid);
    announced.publisher.put(payload).attachment(attached).wait()
}

/// Declares a publisher with the quality of service that its token tells, as rmw_zenoh does: reliable, but
/// a congested link drops messages and never holds the thread up.
fn announce(
    session: &Session,
    node: &NodeIdentity,
    topic: &Topic,
    entity: u32,
) -> zenoh::Result<Announced> {
    let publisher = session
        .declare_publisher(topic_key(node.domain, &topic.name, topic.message))
        .congestion_control(CongestionControl::Drop)
        .reliability(Reliability::Reliable)
        .wait()?;
    let token = node.publisher_token(entity, &topic.name, topic.message);
    let gid = gid(&token);
    let token = session.liveliness().declare_token(token).wait()?;
    Ok(Announced { publisher, _token: token, gid, sequence: 0 })
}
