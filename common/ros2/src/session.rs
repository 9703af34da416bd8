//! The thread that opens the session and passes messages to Zenoh.

use std::{
    collections::{BTreeMap, btree_map::Entry},
    mem::discriminant,
    sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed, Ordering::SeqCst},
    time::{Duration, SystemTime, UNIX_EPOCH},
};

use flockeye_network::{NetworkError, open_session};
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
use crate::parameters::Ros2Parameters;

/// Time between two attempts to open the session.
const RETRY: Duration = Duration::from_secs(1);

/// The name of a topic, beginning with '/', and its type of message.
type Topic = (String, MessageType);

/// State that the node and the thread share.
#[derive(Debug)]
pub(crate) struct Ros2Session {
    parameters: Ros2Parameters,
    /// Namespace of the node, beginning with '/'.
    namespace: String,
    /// CDR bytes of the newest message of each topic.
    pub(crate) outbox: Slots<Topic, Vec<u8>>,
    pub(crate) is_open: AtomicBool,
    pub(crate) sent: AtomicU64,
    pub(crate) failed: AtomicU64,
}

/// A publisher that is announced to ROS nodes.
struct Announced {
    publisher: Publisher<'static>,
    /// Announces the publisher until dropped.
    _token: LivelinessToken,
    gid: [u8; 16],
    sequence: i64,
}

impl Ros2Session {
    pub(crate) fn new(parameters: Ros2Parameters, namespace: String) -> Self {
        Self {
            parameters,
            namespace,
            outbox: Slots::default(),
            is_open: AtomicBool::new(false),
            sent: AtomicU64::new(0),
            failed: AtomicU64::new(0),
        }
    }

    pub(crate) fn run(&self) {
        let Some(session) = self.open() else { return };
        self.is_open.store(true, SeqCst);
        if let Err(error) = self.serve(&session) {
            tracing::error!("nothing is published to ROS 2 any more: {error}");
        }
        // The closed outbox returns errors to the caller from now on.
        self.outbox.close();
    }

    /// Opens the session, without a timeout; none once the node is dropped.
    fn open(&self) -> Option<Session> {
        // Each kind of error is logged once: the second may occur long after the first.
        let mut told = Vec::new();
        let config = self.parameters.zenoh_config().to_string();
        loop {
            match open(&config) {
                Ok(session) => return Some(session),
                Err(error) => {
                    let kind = discriminant(&error);
                    if !told.contains(&kind) {
                        let routers = self.parameters.connect.join(", ");
                        tracing::warn!(
                            "ROS 2 is not reached through a router at {routers} yet, still trying: {error}"
                        );
                        told.push(kind);
                    }
                }
            }
            if self.outbox.wait_closed(RETRY) {
                return None;
            }
        }
    }

    fn serve(&self, session: &Session) -> zenoh::Result<()> {
        let node = NodeIdentity {
            domain: self.parameters.domain,
            session: session.zid().to_string(),
            namespace: self.namespace.clone(),
            name: "flockeye".into(),
        };
        let _token = session.liveliness().declare_token(node.token()).wait()?;
        let mut publishers = BTreeMap::new();
        let mut warnings = Throttle::default();
        while let Some((topic, payload)) = self.outbox.take() {
            match send(session, &node, &mut publishers, &topic, payload) {
                Ok(()) => self.sent.fetch_add(1, Relaxed),
                Err(error) => {
                    if let Some(held_back) = warnings.admit() {
                        let (name, _) = &topic;
                        tracing::warn!(held_back, "a message on {name} was not sent: {error}");
                    }
                    self.failed.fetch_add(1, Relaxed)
                }
            };
        }
        Ok(())
    }
}

fn open(config: &str) -> Result<Session, Ros2Error> {
    let session = open_session(config)?;
    if session.info().routers_zid().wait().next().is_none() {
        session.close().wait().map_err(|error| NetworkError::Zenoh {
            what: "close a session",
            reason: error.to_string(),
        })?;
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

/// Declares a publisher with the quality of service in its token, as rmw_zenoh does. It is
/// reliable, but a congested link drops messages and never blocks the thread.
fn announce(
    session: &Session,
    node: &NodeIdentity,
    (name, message): &Topic,
    entity: u32,
) -> zenoh::Result<Announced> {
    let publisher = session
        .declare_publisher(topic_key(node.domain, name, *message))
        .congestion_control(CongestionControl::Drop)
        .reliability(Reliability::Reliable)
        .wait()?;
    let token = node.publisher_token(entity, name, *message);
    let gid = gid(&token);
    let token = session.liveliness().declare_token(token).wait()?;
    Ok(Announced { publisher, _token: token, gid, sequence: 0 })
}
