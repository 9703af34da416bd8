//! The node as the rest of the program sees it.

use std::{
    sync::{
        Arc, Mutex,
        atomic::{Ordering::Relaxed, Ordering::SeqCst},
    },
    thread::JoinHandle,
};

use flockeye_contract::wire::{is_name, shortened};
use flockeye_network::{SendCounters, spawn};
use flockeye_runtime::lock::lock;
use flockeye_runtime::slots::Closed;

use crate::error::Ros2Error;
use crate::messages::{Ros2Message, TfMessage};
use crate::names::{Names, TRANSFORMS, pose_topic, ros_name};
use crate::parameters::Ros2Parameters;
use crate::pose::{ObserverSeen, RelativePose, odometry};
use crate::session::Ros2Session;

/// The ROS 2 node `/<observer>/flockeye`, which publishes until dropped.
///
/// What is published goes into a slot of its topic, and the call returns; a separate thread hands
/// it to Zenoh. So neither a router that is not there nor a stalled link ever blocks the caller:
/// waiting messages are replaced by newer ones.
#[derive(Debug)]
pub struct Ros2Node {
    /// The observer's name in ROS.
    observer: String,
    /// What the node's topics are below, beginning with '/'.
    namespace: String,
    targets: Mutex<Names>,
    peers: Mutex<Names>,
    session: Arc<Ros2Session>,
    thread: Option<JoinHandle<()>>,
}

impl Ros2Node {
    /// Makes the node of the drone `observer`. Returns at once: the session, which is its own, is
    /// opened in the background, whenever a router comes. Lost links are restored in the background
    /// too.
    ///
    /// # Errors
    /// [`Ros2Error::Network`] says what to change, or that there is no thread; [`Ros2Error::Name`]:
    /// `observer` is no name of a drone.
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
        let session = Arc::new(Ros2Session::new(parameters.clone(), namespace.clone()));
        let background = session.clone();
        let thread = spawn("ros2-sender", move || background.run())?;
        Ok(Self {
            observer: in_ros,
            namespace,
            targets: Mutex::new(Names::new(observer)),
            peers: Mutex::new(Names::new(observer)),
            session,
            thread: Some(thread),
        })
    }

    /// Publishes where a neighbour is, on `/<observer>/neighbours/<target>/pose`. Returns at once.
    ///
    /// # Errors
    /// [`Ros2Error::Pose`], [`Ros2Error::Stamp`], [`Ros2Error::Name`], [`Ros2Error::Collision`] and
    /// [`Ros2Error::TooManyDrones`] for a message that is not published; it is counted as failed,
    /// and others are unaffected. [`Ros2Error::Closed`].
    pub fn publish_neighbour(&self, neighbour: &RelativePose) -> Result<(), Ros2Error> {
        let put = || {
            let message = neighbour.message(&self.observer)?;
            let target = lock(&self.targets).admit(&neighbour.name)?;
            self.put(pose_topic(&self.namespace, &target), &message)
        };
        self.counted(put())
    }

    /// Publishes where the neighbours of one frame are, on `/tf`. Returns at once. All of them in
    /// one call: a message that waits is replaced by the next.
    ///
    /// # Errors
    /// As [`publish_neighbour`](Self::publish_neighbour): the first that cannot be published. The
    /// others are published nevertheless.
    pub fn publish_transforms(&self, neighbours: &[RelativePose]) -> Result<(), Ros2Error> {
        self.counted(self.put_transforms(neighbours))
    }

    /// Publishes where a peer sees the observer, on `/<observer>/seen_by/<peer>/odometry`. Returns
    /// at once.
    ///
    /// # Errors
    /// As [`publish_neighbour`](Self::publish_neighbour).
    pub fn publish_odometry(&self, seen: &ObserverSeen) -> Result<(), Ros2Error> {
        let put = || {
            let stamp = seen.check()?;
            let peer = lock(&self.peers).admit(&seen.pose.name)?;
            let message = odometry(seen, stamp, &self.observer, &peer);
            self.put(format!("{}/seen_by/{peer}/odometry", self.namespace), &message)
        };
        self.counted(put())
    }

    /// How many messages were sent, replaced and refused.
    pub fn counters(&self) -> SendCounters {
        SendCounters {
            sent: self.session.sent.load(Relaxed),
            overwritten: self.session.outbox.overwritten(),
            failed: self.session.failed.load(Relaxed),
        }
    }

    /// Whether the session is open. A client's is once it has found its router.
    pub fn is_open(&self) -> bool {
        self.session.is_open.load(SeqCst)
    }

    /// Puts what can be published; gives the first reason why another cannot.
    fn put_transforms(&self, neighbours: &[RelativePose]) -> Result<(), Ros2Error> {
        let mut transforms = Vec::with_capacity(neighbours.len());
        let mut refused = Ok(());
        for neighbour in neighbours {
            let transform = neighbour.check().and_then(|_| {
                let target = lock(&self.targets).admit(&neighbour.name)?;
                neighbour.transform(&self.observer, &target)
            });
            match transform {
                Ok(transform) => transforms.push(transform),
                Err(error) => refused = refused.and(Err(error)),
            }
        }
        if !transforms.is_empty() {
            self.put(TRANSFORMS.into(), &TfMessage { transforms })?;
        }
        refused
    }

    fn put<M: Ros2Message>(&self, topic: String, message: &M) -> Result<(), Ros2Error> {
        let payload = message.to_cdr()?;
        self.session.outbox.put((topic, M::TYPE), payload).map_err(|Closed| Ros2Error::Closed)
    }

    fn counted(&self, published: Result<(), Ros2Error>) -> Result<(), Ros2Error> {
        if published.is_err() {
            self.session.failed.fetch_add(1, Relaxed);
        }
        published
    }
}

impl Drop for Ros2Node {
    /// Sends what is waiting, then withdraws the node. On a stalled link this may take two seconds,
    /// after which Zenoh closes the link. A session that is not open yet is not waited for.
    fn drop(&mut self) {
        self.session.outbox.close();
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
