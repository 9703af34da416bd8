//! Publishers and subscribers of the contract's topics, over iceoryx2.
//!
//! Each topic is a publish-subscribe service and an event service of the same name, which wakes
//! the subscribers. The launcher creates both with explicit limits ([`create_services`]); stages
//! open them, and are refused if they speak another version of the contract.
//!
//! | module | what it has |
//! | --- | --- |
//! | [`publisher`] | publishers, and messages that are being written |
//! | [`subscriber`] | subscribers, which check what comes |

pub mod publisher;
pub mod subscriber;

mod error;

use std::fmt::Debug;
use std::rc::Rc;
use std::time::Duration;

use flockeye_contract::{CONTRACT_VERSION, Topic, TopicVisitor, VERSION_ATTRIBUTE, visit_topics};
use iceoryx2::port::listener::Listener;
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::{event, publish_subscribe};

use crate::health::SharedCounters;
use crate::listening::Listening;
use crate::memory::{Budget, Limits, MAX_EVENT_PORTS, MAX_NODES};
use crate::umask::with_own_umask;

pub use self::error::PortError;
pub use self::publisher::{Loan, Publisher, UnsentMessage};
pub use self::subscriber::{Judged, Message, Sender, Subscriber};

type Service = ipc::Service;
type DataService<T> =
    publish_subscribe::PortFactory<Service, [<T as Topic>::Item], <T as Topic>::Header>;
type WakeService = event::PortFactory<Service>;

/// Keeps a topic's services alive while no stage has them open.
pub struct TopicServices {
    _data: Box<dyn std::any::Any>,
    _wake: WakeService,
}

/// Creates the services of one topic, every lane of it, with its limits. Where stages fly on without a
/// launcher, the services are there, and must have these limits.
///
/// # Errors
/// [`PortError::Create`] with iceoryx2's reason.
pub fn create_services<T: Topic + 'static>(
    node: &Node<Service>,
    limits: &Limits,
) -> Result<Vec<TopicServices>, PortError> {
    (0..limits.lanes).map(|lane| create_lane::<T>(node, limits, lane)).collect()
}

/// Creates the services of all topics, with their limits.
///
/// # Errors
/// [`PortError::Create`] with iceoryx2's reason.
pub fn create_all_services(
    node: &Node<Service>,
    budget: &Budget,
) -> Result<Vec<TopicServices>, PortError> {
    struct Creation<'a> {
        node: &'a Node<Service>,
        budget: &'a Budget,
        services: Vec<TopicServices>,
    }
    impl TopicVisitor for Creation<'_> {
        type Error = PortError;

        fn visit<T: Topic + 'static>(&mut self) -> Result<(), PortError> {
            let limits = self.budget.topic::<T>();
            self.services.extend(create_services::<T>(self.node, limits)?);
            Ok(())
        }
    }
    let mut creation = Creation { node, budget, services: Vec::new() };
    visit_topics(&mut creation)?;
    Ok(creation.services)
}

fn create_lane<T: Topic + 'static>(
    node: &Node<Service>,
    limits: &Limits,
    lane: usize,
) -> Result<TopicServices, PortError> {
    let failed =
        |reason: &dyn Debug| PortError::Create { topic: T::NAME, reason: format!("{reason:?}") };
    let name = service_name::<T>(limits, lane)?;
    let version = AttributeVerifier::new()
        .require(&attribute(VERSION_ATTRIBUTE)?, &attribute(CONTRACT_VERSION)?)
        .map_err(|error| failed(&error))?;
    let data = node
        .service_builder(&name)
        .publish_subscribe::<[T::Item]>()
        .user_header::<T::Header>()
        .enable_safe_overflow(limits.patience.is_none())
        .max_publishers(limits.publishers)
        .max_subscribers(limits.subscribers)
        .max_nodes(MAX_NODES)
        .subscriber_max_buffer_size(limits.buffer)
        .subscriber_max_borrowed_samples(limits.borrowed)
        .history_size(limits.history)
        .open_or_create_with_attributes(&version)
        .map_err(|error| failed(&error))?;
    let wake = node
        .service_builder(&name)
        .event()
        .max_listeners(MAX_EVENT_PORTS)
        .max_notifiers(MAX_EVENT_PORTS)
        .max_nodes(MAX_NODES)
        .open_or_create()
        .map_err(|error| failed(&error))?;
    Ok(TopicServices { _data: Box::new(data), _wake: wake })
}

/// Name of a lane's service: the topic's own name, or `NAME/0`, `NAME/1` ... for a topic with lanes.
fn service_name<T: Topic>(limits: &Limits, lane: usize) -> Result<ServiceName, PortError> {
    let name = match limits.has_lanes {
        true => format!("{}/{lane}", T::NAME),
        false => T::NAME.to_owned(),
    };
    name.as_str()
        .try_into()
        .map_err(|error| PortError::Create { topic: T::NAME, reason: format!("{error:?}") })
}

fn attribute<A: for<'a> TryFrom<&'a str>>(text: &'static str) -> Result<A, PortError> {
    A::try_from(text)
        .map_err(|_| PortError::Create { topic: text, reason: "not an attribute".into() })
}

/// Opens ports of one process, and remembers what wakes it.
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
    /// Ports of a process of the pipeline whose limits are `budget`; what they see is counted in
    /// `counters`.
    pub fn new(node: Rc<Node<Service>>, budget: Budget, counters: SharedCounters) -> Self {
        let listening = Rc::new(Listening::default());
        Self { node, budget, counters, listening, listeners: Vec::new(), wakes: true }
    }

    /// The same, but only messages that `listening` admits are received.
    pub fn listening_to(self, listening: Rc<Listening>) -> Self {
        Self { listening, ..self }
    }

    /// The same, but no message wakes this process: [`Ports::attend`] calls its body by the clock alone. Senders
    /// then do nothing for it. It must look often enough that its buffers do not overflow.
    pub fn polled(self) -> Self {
        Self { wakes: false, ..self }
    }

    /// Whose messages count here.
    pub fn listening(&self) -> Rc<Listening> {
        self.listening.clone()
    }

    /// More ports of the same process, which can be closed apart. Their messages do not wake [`Ports::attend`].
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

    /// Follows the launcher's word whose messages count while it swaps a stage.
    ///
    /// # Errors
    /// As [`Ports::subscriber`].
    pub fn follow_hand_overs(&mut self) -> Result<(), PortError> {
        // Not counted, and with no wish to ask itself.
        let hand_overs = self.subscriber()?.counted_in(SharedCounters::default());
        self.listening.follow(hand_overs.listening_to(Rc::default()));
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

    /// The same, with all the room that the topic has, for a reader that may be late.
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
        let join =
            |reason: &dyn Debug| PortError::Join { topic: T::NAME, reason: format!("{reason:?}") };
        if self.wakes {
            let listener = with_own_umask(|| wake.listener_builder().create());
            self.listeners.push(listener.map_err(|error| join(&error))?);
        }
        Subscriber::join(data, buffer, self.counters.clone(), self.listening.clone())
    }

    /// Calls `body` whenever a subscriber has a message, and at the latest after the time that `body`
    /// returned. Ends when `body` returns `None`.
    ///
    /// # Errors
    /// Waiting is impossible, or what `body` returns.
    pub fn attend(
        &self,
        mut body: impl FnMut() -> anyhow::Result<Option<Duration>>,
    ) -> anyhow::Result<()> {
        let cannot = |reason: &dyn Debug| anyhow::anyhow!("cannot wait for messages: {reason:?}");
        let waiting = WaitSetBuilder::new()
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create::<Service>()
            .map_err(|error| cannot(&error))?;
        let attached: Result<Vec<_>, _> =
            self.listeners.iter().map(|listener| waiting.attach_notification(listener)).collect();
        let _attached = attached.map_err(|error| cannot(&error))?;
        while let Some(timeout) = body()? {
            if waiting.is_empty() {
                std::thread::sleep(timeout);
            } else if !timeout.is_zero()
                && let Err(error) = waiting
                    .wait_and_process_once_with_timeout(|_| CallbackProgression::Continue, timeout)
            {
                // A signal interrupts the wait; `body` knows whether it asks the process to stop.
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
        let failed =
            |reason: &dyn Debug| PortError::Open { topic: T::NAME, reason: format!("{reason:?}") };
        let name = service_name::<T>(self.budget.topic::<T>(), lane)?;
        let version = AttributeVerifier::new()
            .require(&attribute(VERSION_ATTRIBUTE)?, &attribute(CONTRACT_VERSION)?)
            .map_err(|error| failed(&error))?;
        let data = self
            .node
            .service_builder(&name)
            .publish_subscribe::<[T::Item]>()
            .user_header::<T::Header>()
            .open_with_attributes(&version)
            .map_err(|error| failed(&error))?;
        let wake =
            self.node.service_builder(&name).event().open().map_err(|error| failed(&error))?;
        Ok((data, wake))
    }
}
