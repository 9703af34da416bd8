//! The node's interface for the rest of the program.

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

use crate::error::Ros2Error;
use crate::messages::{Ros2Message, TfMessage};
use crate::names::{Names, TRANSFORMS, pose_topic, ros_name};
use crate::parameters::Ros2Parameters;
use crate::pose::{ObserverSeen, RelativePose, odometry};
use crate::session::Ros2Session;

/// The ROS 2 node `/<observer>/flockeye`, which publishes until dropped.
///
/// A published message goes into a slot of its topic, and the call returns. A separate thread
/// passes it to Zenoh. So neither a missing router nor a blocked link ever blocks the caller: newer
/// messages replace those that wait.
#[derive(Debug)]
pub struct Ros2Node {
    /// The observer's name in ROS.
    observer: String,
    /// The prefix of the node's topics, beginning with '/'.
    namespace: String,
    targets: Mutex<Names>,
    peers: Mutex<Names>,
    session: Arc<Ros2Session>,
    thread: Option<JoinHandle<()>>,
}

impl Ros2Node {
    /// Creates the node of the drone `observer`. Returns at once: its own session is opened in the
    /// background, as soon as a router is there. Lost links are restored in the background too.
    ///
    /// # Errors
    /// [`Ros2Error::Network`]: a parameter is invalid, or no thread can be started.
    /// [`Ros2Error::Name`]: `observer` is no name of a drone.
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

    /// Publishes a neighbour's pose on `/<observer>/neighbours/<target>/pose`. Returns at once.
    ///
    /// # Errors
    /// [`Ros2Error::Pose`], [`Ros2Error::Stamp`], [`Ros2Error::Name`], [`Ros2Error::Collision`] and
    /// [`Ros2Error::TooManyDrones`] for a message that is not published. It is counted as failed,
    /// and others are unaffected. [`Ros2Error::Closed`] after the end of the session.
    pub fn publish_neighbour(&self, neighbour: &RelativePose) -> Result<(), Ros2Error> {
        let put = || {
            let message = neighbour.message(&self.observer)?;
            let target = lock(&self.targets).admit(&neighbour.name)?;
            self.put(pose_topic(&self.namespace, &target), &message)
        };
        self.counted(put())
    }

    /// Publishes the poses of a frame's neighbours on `/tf`. Returns at once. One call has all of
    /// them, because the next message replaces one that waits.
    ///
    /// # Errors
    /// As [`publish_neighbour`](Self::publish_neighbour): the first error. The other neighbours are
    /// published nevertheless.
    pub fn publish_transforms(&self, neighbours: &[RelativePose]) -> Result<(), Ros2Error> {
        self.counted(self.put_transforms(neighbours))
    }

    /// Publishes the observer's pose relative to a peer on `/<observer>/seen_by/<peer>/odometry`.
    /// Returns at once.
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

    /// Numbers of messages that were sent, replaced and refused.
    pub fn counters(&self) -> SendCounters {
        SendCounters {
            sent: self.session.sent.load(Relaxed),
            overwritten: self.session.outbox.overwritten(),
            failed: self.session.failed.load(Relaxed),
        }
    }

    /// Whether the session is open, with its router found.
    pub fn is_open(&self) -> bool {
        self.session.is_open.load(SeqCst)
    }

    /// Queues the valid transforms; returns the first error of another.
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
        self.session.outbox.put((topic, M::TYPE), payload).map_err(|_| Ros2Error::Closed)
    }

    fn counted(&self, published: Result<(), Ros2Error>) -> Result<(), Ros2Error> {
        if published.is_err() {
            self.session.failed.fetch_add(1, Relaxed);
        }
        published
    }
}

impl Drop for Ros2Node {
    /// Sends the waiting messages, then withdraws the node. On a blocked link this may take two
    /// seconds, after which Zenoh closes the link. A session that is not open yet is not waited
    /// for.
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
