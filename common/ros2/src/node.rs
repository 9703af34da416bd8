//! The node as the rest of the program sees it.

use std::{
    sync::{
        Arc, Mutex,
        atomic::{Ordering::Relaxed, Ordering::SeqCst},
    },
    thread::{self, JoinHandle},
};

use flockeye_contract::wire::{is_name, shortened};
use flockeye_runtime::lock::lock;
use flockeye_runtime::slots::Closed;

use crate::error::Ros2Error;
use crate::messages::{Message, TfMessage, TransformStamped};
use crate::names::{Names, TRANSFORMS, pose_topic, ros_name};
use crate::parameters::Ros2Parameters;
use crate::pose::{NeighbourPose, ObserverSeen, odometry, pose_message, transform};
use crate::sender::{Sender, Shared, Topic};

/// The ROS 2 node `/<observer>/flockeye`, which publishes until dropped.
///
/// What is published goes into a slot of its topic, and the call returns; a separate thread hands it to
/// Zenoh. So neither a router that is not there nor a stalled link ever blocks the caller: waiting messages
/// are replaced by newer ones.
#[derive(Debug)]
pub struct Ros2Node {
    /// The observer's name in ROS.
    observer: String,
    /// What the node's topics are below, beginning with '/'.
    namespace: String,
    targets: Mutex<Names>,
    peers: Mutex<Names>,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

/// How many messages were sent, replaced and refused.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Ros2Counters {
    /// Handed to Zenoh, which may still drop them on a congested link.
    pub sent: u64,
    /// Replaced by a newer message on the same topic before they were sent.
    pub overwritten: u64,
    /// Refused by the node or by Zenoh.
    pub failed: u64,
}

impl Ros2Node {
    /// Makes the node of the drone `observer`. Returns at once: the session, which is its own, is opened
    /// in the background, whenever a router comes. Lost links are restored in the background too.
    ///
    /// # Errors
    /// [`Ros2Error::Parameter`] says what to change; [`Ros2Error::Name`]: `observer` is no name of a
    /// drone; [`Ros2Error::Thread`].
    pub fn open(parameters: &Ros2Parameters, observer: &str) -> Result<Self, Ros2Error> {
        parameters.check()?;
        if !is_name(observer) {
            let reason = "has no name of 1 to 31 letters, digits, '-', '_' or '.'";
            return Err(Ros2Error::Name { name: shortened(observer), reason });
        }
        let in_ros = ros_name(observer);
        if in_ros != observer {
            tracing::info!(
                "the observer '{observer}' is '{in_ros}' in ROS, for its rules of names"
            );
        }
        let namespace = format!("{}/{in_ros}", parameters.namespace);
        let shared = Arc::new(Shared::default());
        let sender = Sender {
            config: parameters.zenoh_config().to_string(),
            mode: parameters.mode,
            whereabouts: parameters.whereabouts(),
            domain: parameters.domain,
            namespace: namespace.clone(),
            shared: shared.clone(),
        };
        let name = "ros2-sender";
        let thread = thread::Builder::new()
            .name(name.into())
            .spawn(move || sender.run())
            .map_err(|source| Ros2Error::Thread { name, source })?;
        Ok(Self {
            observer: in_ros,
            namespace,
            targets: Mutex::new(Names::new(observer)),
            peers: Mutex::new(Names::new(observer)),
            shared,
            thread: Some(thread),
        })
    }

    /// Publishes where a neighbour is, on `/<observer>/neighbours/<target>/pose`. Returns at once.
    ///
    /// # Errors
    /// [`Ros2Error::Pose`], [`Ros2Error::Stamp`], [`Ros2Error::Name`], [`Ros2Error::Collision`] and
    /// [`Ros2Error::TooManyDrones`] for a message that is not published; it is counted as failed, and
    /// others are unaffected. [`Ros2Error::Closed`].
    pub fn publish_neighbour(&self, neighbour: &NeighbourPose) -> Result<(), Ros2Error> {
        self.counted(self.put_neighbour(neighbour))
    }

    /// Publishes where the neighbours of one frame are, on `/tf`. Returns at once. All of them in one
    /// call: a message that waits is replaced by the next.
    ///
    /// # Errors
    /// As [`publish_neighbour`](Self::publish_neighbour): the first that cannot be published. The
    /// others are published nevertheless.
    pub fn publish_transforms(&self, neighbours: &[NeighbourPose]) -> Result<(), Ros2Error> {
        self.counted(self.put_transforms(neighbours))
    }

    /// Publishes where a peer sees the observer, on `/<observer>/seen_by/<peer>/odometry`. Returns at once.
    ///
    /// # Errors
    /// As [`publish_neighbour`](Self::publish_neighbour).
    pub fn publish_odometry(&self, seen: &ObserverSeen) -> Result<(), Ros2Error> {
        self.counted(self.put_odometry(seen))
    }

    /// How many messages were sent, replaced and refused.
    pub fn counters(&self) -> Ros2Counters {
        Ros2Counters {
            sent: self.shared.sent.load(Relaxed),
            overwritten: self.shared.outbox.overwritten(),
            failed: self.shared.failed.load(Relaxed),
        }
    }

    /// Whether the session is open. A client's is once it has found its router.
    pub fn is_open(&self) -> bool {
        self.shared.is_open.load(SeqCst)
    }

    fn put_neighbour(&self, neighbour: &NeighbourPose) -> Result<(), Ros2Error> {
        let stamp = neighbour.pose.check(&neighbour.target)?;
        let target = lock(&self.targets).admit(&neighbour.target)?;
        let message = pose_message(&neighbour.pose, stamp, &self.observer);
        self.put(pose_topic(&self.namespace, &target), &message)
    }

    fn put_odometry(&self, seen: &ObserverSeen) -> Result<(), Ros2Error> {
        let stamp = seen.check()?;
        let peer = lock(&self.peers).admit(&seen.peer)?;
        let message = odometry(seen, stamp, &self.observer, &peer);
        self.put(format!("{}/seen_by/{peer}/odometry", self.namespace), &message)
    }

    fn put_transforms(&self, neighbours: &[NeighbourPose]) -> Result<(), Ros2Error> {
        let mut transforms = Vec::with_capacity(neighbours.len());
        let mut refused = Ok(());
        for neighbour in neighbours {
            match self.transform(neighbour) {
                Ok(transform) => transforms.push(transform),
                Err(error) => refused = refused.and(Err(error)),
            }
        }
        if !transforms.is_empty() {
            self.put(TRANSFORMS.into(), &TfMessage { transforms })?;
        }
        refused
    }

    fn transform(&self, neighbour: &NeighbourPose) -> Result<TransformStamped, Ros2Error> {
        let stamp = neighbour.pose.check(&neighbour.target)?;
        let target = lock(&self.targets).admit(&neighbour.target)?;
        Ok(transform(&neighbour.pose, stamp, &self.observer, &target))
    }

    fn put<M: Message>(&self, name: String, message: &M) -> Result<(), Ros2Error> {
        let payload = message.to_cdr()?;
        let topic = Topic { name, message: M::TYPE };
        self.shared.outbox.put(topic, payload).map_err(|Closed| Ros2Error::Closed)
    }

    fn counted(&self, published: Result<(), Ros2Error>) -> Result<(), Ros2Error> {
        if published.is_err() {
            self.shared.failed.fetch_add(1, Relaxed);
        }
        published
    }
}

impl Drop for Ros2Node {
    /// Sends what is waiting, then withdraws the node. On a stalled link this may take two seconds, after
    /// which Zenoh closes the link. A session that is not open yet is not waited for.
    fn drop(&mut self) {
        self.shared.outbox.close();
        if !self.is_open() {
            return;
        }
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::error!("the ROS 2 node's thread panicked");
        }
    }
}
