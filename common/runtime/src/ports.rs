//! Publishers and subscribers of the contract's topics, over iceoryx2.
//!
//! Each topic is a publish-subscribe service and an event service of the same name, which wakes the
//! subscribers. The launcher creates both with explicit limits ([`create_services`]). Stages open
//! them, and are refused if they have another version of the contract.
//!
//! | module | content |
//! | --- | --- |
//! | `services` | the services |
//! | `publisher` | publishers, and messages that are being written |
//! | `subscriber` | subscribers, which check messages |
//! | `error` | errors of opening and using ports |

mod error;
mod publisher;
mod services;
mod subscriber;

use std::rc::Rc;
use std::time::Duration;

use anyhow::anyhow;
use flockeye_contract::{HandOvers, Topic};
use iceoryx2::port::listener::Listener;
use iceoryx2::prelude::*;

use self::services::{DataService, Service, WakeService, service_name, version};
use crate::health::SharedCounters;
use crate::listening::Listening;
use crate::memory::{Budget, Limits};
use crate::umask::with_own_umask;

pub use self::error::PortError;
pub use self::publisher::{Loan, Publisher};
pub use self::services::{TopicServices, create_all_services, create_services};
pub use self::subscriber::{Judged, Message, Sender, Subscriber};

/// Opens ports of one process, and holds the listeners that wake it.
pub struct Ports {
    node: Rc<Node<Service>>,
    budget: Budget,
    counters: SharedCounters,
    listening: Rc<Listening>,
    listeners: Vec<Listener<Service>>,
    /// Whether messages wake this process.
    wakes: bool,
}

impl Ports {
    /// Ports of a process of the pipeline whose limits are `budget`; their messages are counted in
    /// `counters`.
    pub fn new(node: Rc<Node<Service>>, budget: Budget, counters: SharedCounters) -> Self {
        let listening = Rc::new(Listening::default());
        Self { node, budget, counters, listening, listeners: Vec::new(), wakes: true }
    }

    /// Ports that receive only messages that `listening` admits.
    pub(crate) fn listening_to(self, listening: Rc<Listening>) -> Self {
        Self { listening, ..self }
    }

    /// Ports whose messages do not wake this process: [`Ports::attend`] calls its body by the clock
    /// alone. Senders then have no extra work. The process must poll often enough that its buffers
    /// do not overflow.
    pub fn polled(self) -> Self {
        Self { wakes: false, ..self }
    }

    /// The filter of the messages that count here.
    pub fn listening(&self) -> Rc<Listening> {
        self.listening.clone()
    }

    /// Further ports of the same process, which can be closed separately. Their messages do not
    /// wake [`Ports::attend`].
    pub fn beside(&self) -> Self {
        Self {
            node: self.node.clone(),
            budget: self.budget.clone(),
            counters: self.counters.clone(),
            listening: self.listening.clone(),
            listeners: Vec::new(),
            wakes: self.wakes,
        }
    }

    /// Follows the launcher's announcements while it swaps a stage.
    ///
    /// # Errors
    /// As [`Ports::subscriber`].
    pub fn follow_hand_overs(&mut self) -> Result<(), PortError> {
        // Hand-overs are not counted, and no hand-over filters them.
        let hand_overs: Subscriber<HandOvers> = self.subscriber()?;
        let mut hand_overs =
            hand_overs.counted_in(SharedCounters::default()).listening_to(Rc::default());
        self.listening.follow(move || match hand_overs.newest() {
            Ok(message) => message.map(|message| message.header),
            Err(error) => {
                tracing::debug!("hand-overs cannot be read: {error}");
                None
            }
        });
        Ok(())
    }

    /// A publisher of a topic.
    ///
    /// # Errors
    /// The topic is not there, is of another contract version, or is full.
    pub fn publisher<T: Topic>(&self) -> Result<Publisher<T>, PortError> {
        self.publisher_of_lane(0)
    }

    /// A publisher of a topic that is not the stage's main output: its messages are not counted.
    ///
    /// # Errors
    /// As [`Ports::publisher`].
    pub fn side_publisher<T: Topic>(&self) -> Result<Publisher<T>, PortError> {
        Ok(self.publisher_of_lane(0)?.counted_in(SharedCounters::default()))
    }

    /// A publisher of one lane of a topic.
    ///
    /// # Errors
    /// As [`Ports::publisher`].
    pub fn publisher_of_lane<T: Topic>(&self, lane: usize) -> Result<Publisher<T>, PortError> {
        let (data, wake) = self.open::<T>(lane)?;
        Publisher::join(data, &wake, self.budget.topic::<T>(), self.counters.clone())
    }

    /// A subscriber of a topic. Its messages wake this process, unless it polls.
    ///
    /// # Errors
    /// The topic is not there, is of another contract version, or is full.
    pub fn subscriber<T: Topic>(&mut self) -> Result<Subscriber<T>, PortError> {
        self.subscriber_of_lane(0)
    }

    /// A subscriber of each lane of a topic.
    ///
    /// # Errors
    /// As [`Ports::subscriber`].
    pub fn subscribers_of_all_lanes<T: Topic>(&mut self) -> Result<Vec<Subscriber<T>>, PortError> {
        let lanes = self.budget.topic::<T>().lanes;
        (0..lanes).map(|lane| self.subscriber_of_lane(lane)).collect()
    }

    /// Subscribers of all lanes with the topic's largest buffer, for a reader that may be late.
    ///
    /// # Errors
    /// As [`Ports::subscriber`].
    pub fn late_subscribers_of_all_lanes<T: Topic>(
        &mut self,
    ) -> Result<Vec<Subscriber<T>>, PortError> {
        let Limits { lanes, buffer, .. } = *self.budget.topic::<T>();
        (0..lanes).map(|lane| self.subscriber_with(lane, buffer)).collect()
    }

    /// A subscriber of one lane of a topic.
    ///
    /// # Errors
    /// As [`Ports::subscriber`].
    pub fn subscriber_of_lane<T: Topic>(
        &mut self,
        lane: usize,
    ) -> Result<Subscriber<T>, PortError> {
        self.subscriber_with(lane, self.budget.topic::<T>().usual_buffer)
    }

    fn subscriber_with<T: Topic>(
        &mut self,
        lane: usize,
        buffer: usize,
    ) -> Result<Subscriber<T>, PortError> {
        let (data, wake) = self.open::<T>(lane)?;
        if self.wakes {
            let listener = with_own_umask(|| wake.listener_builder().create());
            let listener =
                listener.map_err(|reason| PortError::Listener { topic: T::NAME, reason })?;
            self.listeners.push(listener);
        }
        Subscriber::join(data, buffer, self.counters.clone(), self.listening.clone())
    }

    /// Calls `body` whenever a subscriber has a message, and at the latest after the time that
    /// `body` returned. Ends when `body` returns `None`.
    ///
    /// # Errors
    /// Waiting is impossible, or what `body` returns.
    pub fn attend(
        &self,
        mut body: impl FnMut() -> anyhow::Result<Option<Duration>>,
    ) -> anyhow::Result<()> {
        let waiting = WaitSetBuilder::new()
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create::<Service>()
            .map_err(|error| anyhow!("cannot wait for messages: {error:?}"))?;
        let attached: Result<Vec<_>, _> =
            self.listeners.iter().map(|listener| waiting.attach_notification(listener)).collect();
        let _attached = attached.map_err(|error| anyhow!("cannot wait for messages: {error:?}"))?;
        while let Some(timeout) = body()? {
            if waiting.is_empty() {
                std::thread::sleep(timeout);
            } else if !timeout.is_zero()
                && let Err(error) = waiting
                    .wait_and_process_once_with_timeout(|_| CallbackProgression::Continue, timeout)
            {
                // A signal interrupts the wait; `body` checks whether it requests a stop.
                tracing::debug!("waiting was interrupted: {error:?}");
            }
            // A listener that is not drained would wake this process again and again.
            for listener in &self.listeners {
                if let Err(error) = listener.try_wait(|_| {}) {
                    tracing::debug!("a wake-up could not be read: {error:?}");
                }
            }
        }
        Ok(())
    }

    fn open<T: Topic>(&self, lane: usize) -> Result<(DataService<T>, WakeService), PortError> {
        let topic = T::NAME;
        let name = service_name::<T>(self.budget.topic::<T>(), lane);
        let (name, version) = name.zip(version()).ok_or(PortError::OpenName { topic })?;
        let data = self
            .node
            .service_builder(&name)
            .publish_subscribe::<[T::Item]>()
            .user_header::<T::Header>()
            .open_with_attributes(&version)
            .map_err(|reason| PortError::OpenMessages { topic, reason })?;
        let wake = self.node.service_builder(&name).event().open();
        Ok((data, wake.map_err(|reason| PortError::OpenWakeUps { topic, reason })?))
    }
}
