//! Publishers and subscribers of the contract's topics, over iceoryx2.
//!
//! Each topic is a publish-subscribe service and an event service of the same name, which wakes
//! the subscribers. The launcher creates both with explicit limits ([`create_services`]); stages
//! open them, and are refused if they speak another version of the contract.

use std::collections::BTreeSet;
use std::fmt::Debug;
use std::mem::MaybeUninit;
use std::rc::Rc;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use flockeye_contract::{
    CONTRACT_VERSION, ContractError, Topic, TopicVisitor, VERSION_ATTRIBUTE, visit_topics,
};
use iceoryx2::identifiers::UniquePublisherId;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher as IoxPublisher;
use iceoryx2::port::subscriber::Subscriber as IoxSubscriber;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::port::{BackpressureAction, BackpressureInfo};
use iceoryx2::prelude::*;
use iceoryx2::sample::Sample;
use iceoryx2::sample_mut_uninit::SampleMutUninit;
use iceoryx2::service::port_factory::{event, publish_subscribe};

use crate::health::SharedCounters;
use crate::listening::Listening;
use crate::logs::Throttle;
use crate::memory::{Budget, Limits, MAX_EVENT_PORTS, MAX_NODES};

mod error;

pub use error::PortError;

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
}

impl Ports {
    /// Ports of a process of the pipeline whose limits are `budget`; what they see is counted in
    /// `counters`.
    pub fn new(node: Rc<Node<Service>>, budget: Budget, counters: SharedCounters) -> Self {
        let listening = Rc::new(Listening::default());
        Self { node, budget, counters, listening, listeners: Vec::new() }
    }

    /// The same, but only messages that `listening` admits are received.
    pub fn listening_to(self, listening: Rc<Listening>) -> Self {
        Self { listening, ..self }
    }

    /// Whose messages count here.
    pub fn listening(&self) -> Rc<Listening> {
        self.listening.clone()
    }

    /// Follows the launcher's word whose messages count while it swaps a stage.
    ///
    /// # Errors
    /// As [`Ports::subscriber`].
    pub fn follow_hand_overs(&mut self) -> Result<(), PortError> {
        // Not counted, and with no wish to ask itself.
        let hand_overs = Subscriber {
            counters: SharedCounters::default(),
            listening: Rc::default(),
            ..self.subscriber()?
        };
        self.listening.follow(hand_overs);
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
        let publisher = self.publisher_of_lane(0)?;
        Ok(Publisher { counters: SharedCounters::default(), ..publisher })
    }

    /// A publisher of one lane of a topic.
    ///
    /// # Errors
    /// As [`Ports::publisher`].
    pub fn publisher_of_lane<T: Topic>(&self, lane: usize) -> Result<Publisher<T>, PortError> {
        let limits = self.budget.topic::<T>();
        let (data, wake) = self.open::<T>(lane)?;
        let join =
            |reason: &dyn Debug| PortError::Join { topic: T::NAME, reason: format!("{reason:?}") };
        let publisher = data
            .publisher_builder()
            .initial_max_slice_len(limits.items.max(1))
            .allocation_strategy(AllocationStrategy::Static)
            .max_loaned_samples(limits.loaned)
            .set_backpressure_handler(waits_for_readers(T::NAME, limits.patience))
            .create()
            .map_err(|error| join(&error))?;
        let notifier = wake.notifier_builder().create().map_err(|error| join(&error))?;
        Ok(Publisher {
            publisher,
            notifier,
            counters: self.counters.clone(),
            max_items: limits.items,
        })
    }

    /// A subscriber of a topic whose messages wake this process.
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

    /// A subscriber of one lane of a topic.
    ///
    /// # Errors
    /// As [`Ports::subscriber`].
    pub fn subscriber_of_lane<T: Topic>(
        &mut self,
        lane: usize,
    ) -> Result<Subscriber<T>, PortError> {
        let (data, wake) = self.open::<T>(lane)?;
        let join =
            |reason: &dyn Debug| PortError::Join { topic: T::NAME, reason: format!("{reason:?}") };
        let subscriber = data.subscriber_builder().create().map_err(|error| join(&error))?;
        self.listeners.push(wake.listener_builder().create().map_err(|error| join(&error))?);
        Ok(Subscriber {
            subscriber,
            service: data,
            counters: self.counters.clone(),
            listening: self.listening.clone(),
            refusals: Refusals::default(),
        })
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

/// What a publisher does when a subscriber's buffer is full: it waits for `patience`. It never again
/// waits for a subscriber that took nothing in that time.
fn waits_for_readers(
    topic: &'static str,
    patience: Option<Duration>,
) -> impl Fn(&BackpressureInfo) -> BackpressureAction + Send + 'static {
    let given_up = Mutex::new(BTreeSet::new());
    move |full| {
        // A thread that panicked while it held the lock left the set valid.
        let mut given_up = given_up.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(patience) = patience.filter(|_| !given_up.contains(&full.receiver_port_id)) else {
            return BackpressureAction::DiscardData;
        };
        if full.elapsed_time < patience {
            return BackpressureAction::Retry;
        }
        given_up.insert(full.receiver_port_id);
        tracing::warn!(
            topic,
            "a reader took nothing for {} ms: it is not waited for any more. Cure: end tools that look on \
             at a lossless run; begin it anew if it was fusion",
            patience.as_millis()
        );
        BackpressureAction::DiscardData
    }
}

/// Publishes a topic, and wakes its subscribers.
pub struct Publisher<T: Topic> {
    publisher: IoxPublisher<Service, [T::Item], T::Header>,
    notifier: Notifier<Service>,
    counters: SharedCounters,
    max_items: usize,
}

impl<T: Topic> Publisher<T> {
    /// Memory for a message of `items` items, to be written in place.
    ///
    /// # Errors
    /// More items than the topic has room for, or no memory because subscribers hold too much.
    pub fn loan(&self, items: usize) -> Result<Loan<'_, T>, PortError> {
        if items > self.max_items {
            let reason = format!("{items} items where the topic has room for {}", self.max_items);
            return Err(PortError::Publish { topic: T::NAME, reason });
        }
        let sample = self
            .publisher
            .loan_slice_uninit(items)
            .map_err(|error| PortError::Publish { topic: T::NAME, reason: format!("{error:?}") })?;
        Ok(Loan { sample, publisher: self })
    }

    /// Publishes a small message by copying it.
    ///
    /// # Errors
    /// As [`Publisher::loan`] and [`Loan::send`].
    pub fn send(&self, header: T::Header, items: &[T::Item]) -> Result<(), PortError> {
        let mut loan = self.loan(items.len())?;
        loan.items_mut().copy_from_slice(items);
        loan.send(header)
    }

    /// Updates the connections to subscribers: those that joined since the last message get the topic's
    /// history.
    ///
    /// # Errors
    /// [`PortError::Publish`] with iceoryx2's reason.
    pub fn update_connections(&self) -> Result<(), PortError> {
        self.publisher
            .update_connections()
            .map_err(|error| PortError::Publish { topic: T::NAME, reason: format!("{error:?}") })
    }
}

/// A message that is being written, in shared memory.
pub struct Loan<'p, T: Topic> {
    sample: SampleMutUninit<Service, [MaybeUninit<T::Item>], T::Header>,
    publisher: &'p Publisher<T>,
}

impl<T: Topic> Loan<'_, T> {
    /// The items; at first they hold what was in the memory before.
    pub fn items_mut(&mut self) -> &mut [T::Item] {
        let items = self.sample.payload_mut();
        // SAFETY: the memory is a mapped file, so every byte has a value, and every value is valid
        // for an `Item`, which is `Pod`. The layout of `MaybeUninit<Item>` is that of `Item`.
        unsafe { &mut *(std::ptr::from_mut(items) as *mut [T::Item]) }
    }

    /// Publishes it under `header` and wakes the subscribers.
    ///
    /// # Errors
    /// [`PortError::Publish`] with iceoryx2's reason.
    pub fn send(mut self, header: T::Header) -> Result<(), PortError> {
        let failed = |reason: &dyn Debug| PortError::Publish {
            topic: T::NAME,
            reason: format!("{reason:?}"),
        };
        *self.sample.user_header_mut() = header;
        // SAFETY: as in `items_mut`: every byte of mapped memory has a value, valid for a `Pod`.
        let sample = unsafe { self.sample.assume_init() };
        sample.send().map_err(|error| failed(&error))?;
        self.publisher.counters.add_published(1);
        self.publisher.notifier.notify().map_err(|error| failed(&error))?;
        Ok(())
    }
}

/// Receives a topic. Messages that fail the contract's check are refused here, so no stage sees them.
pub struct Subscriber<T: Topic> {
    subscriber: IoxSubscriber<Service, [T::Item], T::Header>,
    service: DataService<T>,
    counters: SharedCounters,
    listening: Rc<Listening>,
    refusals: Refusals,
}

/// How many messages of each publisher were refused.
#[derive(Default)]
struct Refusals {
    throttle: Throttle,
    counts: Vec<(UniquePublisherId, u64)>,
}

impl Refusals {
    /// Publishers that are told apart; they are few, and old ones have ended.
    const MOST_PUBLISHERS: usize = 16;

    /// Counts one more of `publisher`.
    fn add(&mut self, publisher: UniquePublisherId) -> u64 {
        if let Some((_, count)) = self.counts.iter_mut().find(|(of, _)| *of == publisher) {
            *count += 1;
            return *count;
        }
        if self.counts.len() == Self::MOST_PUBLISHERS {
            self.counts.remove(0);
        }
        self.counts.push((publisher, 1));
        1
    }
}

/// The launcher hears of refused messages once for so many.
const REFUSED_AT_ONCE: u64 = 10;

/// A message, in shared memory, that has passed the contract's check.
pub struct Message<T: Topic> {
    /// Its header, copied, so that later writes to shared memory cannot change what was checked.
    pub header: T::Header,
    sample: Sample<Service, [T::Item], T::Header>,
}

/// A message, and what the contract's check says of it.
pub type Judged<T> = (Message<T>, Result<(), ContractError>);

impl<T: Topic> Message<T> {
    /// Its items.
    pub fn items(&self) -> &[T::Item] {
        self.sample.payload()
    }
}

impl<T: Topic> Subscriber<T> {
    /// The next message, if one is there.
    ///
    /// # Errors
    /// [`PortError::Receive`] where too many messages are held, or a connection broke.
    pub fn receive(&mut self) -> Result<Option<Message<T>>, PortError> {
        loop {
            let sample = self.subscriber.receive().map_err(|error| PortError::Receive {
                topic: T::NAME,
                reason: format!("{error:?}"),
            })?;
            let Some(sample) = sample else { return Ok(None) };
            let header = *sample.user_header();
            if !self.listening.admits(&header) {
                continue;
            }
            match T::check(&header, sample.payload()) {
                Ok(()) => {
                    self.counters.add_taken(1);
                    return Ok(Some(Message { header, sample }));
                }
                Err(error) => {
                    self.counters.add_failed(1);
                    let publisher = sample.origin();
                    let count = self.refusals.add(publisher);
                    if count.is_multiple_of(REFUSED_AT_ONCE) {
                        let pid = self.process_of(publisher);
                        self.listening.complain_of_messages(
                            pid,
                            count,
                            &format!("{}: {error}", T::NAME),
                        );
                    }
                    if let Some(more) = self.refusals.throttle.admit() {
                        tracing::warn!(
                            topic = T::NAME,
                            process = self.process_of(publisher),
                            more_since = more,
                            "message refused: {error}. Cure: mend the stage that sends it; docs/CONTRACT.md has the layout"
                        );
                    }
                }
            }
        }
    }

    /// The next message, if one is there, with what the contract's check says of it: for tools that judge
    /// stages.
    ///
    /// # Errors
    /// As [`Subscriber::receive`].
    pub fn receive_with_verdict(&mut self) -> Result<Option<Judged<T>>, PortError> {
        let sample = self
            .subscriber
            .receive()
            .map_err(|error| PortError::Receive { topic: T::NAME, reason: format!("{error:?}") })?;
        Ok(sample.map(|sample| {
            let header = *sample.user_header();
            let verdict = T::check(&header, sample.payload());
            (Message { header, sample }, verdict)
        }))
    }

    /// The process that has this publisher; 0 if it has ended.
    fn process_of(&self, publisher: UniquePublisherId) -> u32 {
        let mut pid = 0;
        self.service.dynamic_config().list_publishers(|details| {
            if details.publisher_id != publisher {
                return CallbackProgression::Continue;
            }
            let process = details.node_id.pid::<Service>();
            pid = process.map_or(0, |process| process.value().unsigned_abs());
            CallbackProgression::Stop
        });
        pid
    }

    /// Updates the connections to publishers; false if there is no publisher. A publisher with patience
    /// waits for this subscriber only once they are connected.
    ///
    /// # Errors
    /// [`PortError::Receive`] where a connection broke.
    pub fn connect(&self) -> Result<bool, PortError> {
        let is_published = self.service.dynamic_config().number_of_publishers() > 0;
        self.subscriber
            .update_connections()
            .map_err(|error| PortError::Receive { topic: T::NAME, reason: format!("{error:?}") })?;
        Ok(is_published)
    }

    /// The newest message; older ones are dropped and counted.
    ///
    /// # Errors
    /// As [`Subscriber::receive`].
    pub fn newest(&mut self) -> Result<Option<Message<T>>, PortError> {
        let mut newest = None;
        while let Some(message) = self.receive()? {
            if newest.replace(message).is_some() {
                self.counters.add_dropped(1);
            }
        }
        Ok(newest)
    }
}
