//! Subscribers, which refuse messages that break the contract.

use std::rc::Rc;

use flockeye_contract::{ContractError, Topic};
use iceoryx2::identifiers::UniquePublisherId;
use iceoryx2::port::subscriber::Subscriber as IoxSubscriber;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::prelude::*;
use iceoryx2::sample::Sample;

use super::error::PortError;
use super::services::{DataService, Service};
use crate::health::SharedCounters;
use crate::listening::Listening;
use crate::logs::Throttle;

/// A message of a topic in shared memory.
type ShmSample<T> = Sample<Service, [<T as Topic>::Item], <T as Topic>::Header>;

/// Receives a topic. Messages that fail the contract's check are refused here, so no stage sees
/// them.
pub struct Subscriber<T: Topic> {
    subscriber: IoxSubscriber<Service, [T::Item], T::Header>,
    service: DataService<T>,
    counters: SharedCounters,
    listening: Rc<Listening>,
    /// Number of refused messages of each publisher.
    refused: Vec<(Sender, u64)>,
    refusals: Throttle,
}

/// Maximum number of publishers that are counted separately; they are few, and old ones have ended.
const MOST_PUBLISHERS: usize = 16;

/// Counts one more refused message of `publisher`.
fn count_refused(counts: &mut Vec<(Sender, u64)>, publisher: Sender) -> u64 {
    if let Some((_, count)) = counts.iter_mut().find(|(of, _)| *of == publisher) {
        *count += 1;
        return *count;
    }
    if counts.len() == MOST_PUBLISHERS {
        counts.remove(0);
    }
    counts.push((publisher, 1));
    1
}

/// Number of refused messages of one publisher for each complaint to the launcher.
const REFUSED_AT_ONCE: u64 = 10;

/// A message, in shared memory, that has passed the contract's check.
pub struct Message<T: Topic> {
    /// Its header, copied, so that later writes to shared memory cannot change what was checked.
    pub header: T::Header,
    sample: ShmSample<T>,
}

/// The sender of a message.
pub type Sender = UniquePublisherId;

/// A message, and the result of the contract's check.
pub type Judged<T> = (Message<T>, Result<(), ContractError>);

impl<T: Topic> Message<T> {
    /// Its items.
    pub fn items(&self) -> &[T::Item] {
        self.sample.payload()
    }

    /// The sender of the message.
    pub fn sender(&self) -> Sender {
        self.sample.origin()
    }
}

impl<T: Topic> AsRef<[T::Item]> for Message<T> {
    fn as_ref(&self) -> &[T::Item] {
        self.items()
    }
}

impl<T: Topic> Subscriber<T> {
    /// Joins a lane's service; at most `buffer` messages wait here.
    pub(super) fn join(
        service: DataService<T>,
        buffer: usize,
        counters: SharedCounters,
        listening: Rc<Listening>,
    ) -> Result<Self, PortError> {
        let subscriber = service.subscriber_builder().buffer_size(buffer).create();
        let subscriber =
            subscriber.map_err(|reason| PortError::Subscriber { topic: T::NAME, reason })?;
        Ok(Self {
            subscriber,
            service,
            counters,
            listening,
            refused: Vec::new(),
            refusals: Throttle::default(),
        })
    }

    /// The subscriber, with its messages counted elsewhere.
    pub(super) fn counted_in(self, counters: SharedCounters) -> Self {
        Self { counters, ..self }
    }

    /// The subscriber, which receives only messages that `listening` admits.
    pub(super) fn listening_to(self, listening: Rc<Listening>) -> Self {
        Self { listening, ..self }
    }

    /// The next message, if one waits.
    ///
    /// # Errors
    /// [`PortError`] where this process keeps too many messages, or a connection broke.
    pub fn receive(&mut self) -> Result<Option<Message<T>>, PortError> {
        loop {
            let Some(sample) = self.next_sample()? else { return Ok(None) };
            let header = *sample.user_header();
            if !self.listening.admits(T::senders(&header)) {
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
                    self.refuse(publisher, &error);
                    if let Some(more) = self.refusals.admit() {
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

    fn next_sample(&self) -> Result<Option<ShmSample<T>>, PortError> {
        let sample = self.subscriber.receive();
        sample.map_err(|reason| PortError::Receive { topic: T::NAME, reason })
    }

    /// The next message, if one waits, with the result of the contract's check: for tools that
    /// judge stages.
    ///
    /// # Errors
    /// As [`Subscriber::receive`].
    pub fn receive_with_verdict(&mut self) -> Result<Option<Judged<T>>, PortError> {
        Ok(self.next_sample()?.map(|sample| {
            let header = *sample.user_header();
            let verdict = T::check(&header, sample.payload());
            (Message { header, sample }, verdict)
        }))
    }

    /// Counts a refused message, also one that passed the contract's check but cannot be true. The
    /// launcher receives a complaint after each [`REFUSED_AT_ONCE`] messages.
    pub fn refuse(&mut self, sender: Sender, reason: &dyn std::fmt::Display) {
        let count = count_refused(&mut self.refused, sender);
        if count.is_multiple_of(REFUSED_AT_ONCE) {
            let pid = self.process_of(sender);
            self.listening.complain_of_messages(pid, count, &format!("{}: {reason}", T::NAME));
        }
    }

    /// Number of this publisher's process; 0 if it has ended.
    fn process_of(&self, publisher: Sender) -> u32 {
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

    /// Updates the connections to publishers; false if there is no publisher. A publisher with
    /// patience waits for this subscriber only once they are connected.
    ///
    /// # Errors
    /// [`PortError`] where a connection broke.
    pub fn connect(&self) -> Result<bool, PortError> {
        let is_published = self.service.dynamic_config().number_of_publishers() > 0;
        self.subscriber
            .update_connections()
            .map_err(|reason| PortError::SubscriberConnection { topic: T::NAME, reason })?;
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
