//! Publishers, and messages that are being written in shared memory.

use std::collections::BTreeSet;
use std::mem::MaybeUninit;
use std::sync::Mutex;
use std::time::Duration;

use flockeye_contract::Topic;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher as IoxPublisher;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::port::{BackpressureAction, BackpressureInfo};
use iceoryx2::prelude::*;
use iceoryx2::sample_mut_uninit::SampleMutUninit;

use super::error::PortError;
use super::services::{DataService, Service, WakeService};
use crate::health::SharedCounters;
use crate::lock::lock;
use crate::memory::Limits;

/// Handler of a subscriber's full buffer: the publisher waits for `patience`. It never again waits
/// for a subscriber that took nothing in that time.
fn waits_for_readers(
    topic: &'static str,
    patience: Option<Duration>,
) -> impl Fn(&BackpressureInfo) -> BackpressureAction + Send + 'static {
    let given_up = Mutex::new(BTreeSet::new());
    move |full| {
        // A thread that panicked while it held the lock left the set valid.
        let mut given_up = lock(&given_up);
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
    service: DataService<T>,
}

impl<T: Topic> Publisher<T> {
    /// Joins a lane's services.
    pub(super) fn join(
        service: DataService<T>,
        wake: &WakeService,
        limits: &Limits,
        counters: SharedCounters,
    ) -> Result<Self, PortError> {
        let topic = T::NAME;
        let strategy = match limits.grows_to {
            Some(_) => AllocationStrategy::PowerOfTwo,
            None => AllocationStrategy::Static,
        };
        let publisher = service
            .publisher_builder()
            .initial_max_slice_len(limits.items.max(1))
            .allocation_strategy(strategy)
            .max_loaned_samples(limits.loaned)
            .set_backpressure_handler(waits_for_readers(T::NAME, limits.patience))
            .create()
            .map_err(|reason| PortError::Publisher { topic, reason })?;
        let notifier = wake.notifier_builder().create();
        let notifier = notifier.map_err(|reason| PortError::Notifier { topic, reason })?;
        let max_items = limits.grows_to.unwrap_or(limits.items);
        Ok(Self { publisher, notifier, counters, max_items, service })
    }

    /// The publisher, with its messages counted elsewhere.
    pub(super) fn counted_in(self, counters: SharedCounters) -> Self {
        Self { counters, ..self }
    }

    /// Number of subscribers, including those that are not connected yet.
    pub fn readers(&self) -> usize {
        self.service.dynamic_config().number_of_subscribers()
    }

    /// Memory for a message of `items` items, to be written in place.
    ///
    /// # Errors
    /// More items than the topic has room for, or no memory because subscribers keep too many
    /// messages.
    pub fn loan(&self, items: usize) -> Result<Loan<T>, PortError> {
        let (topic, room) = (T::NAME, self.max_items);
        if items > room {
            return Err(PortError::TooManyItems { topic, items, room });
        }
        let sample = self.publisher.loan_slice_uninit(items);
        let sample = sample.map_err(|reason| PortError::Loan { topic, reason })?;
        Ok(Loan { sample })
    }

    /// Publishes a loan of this publisher under `header` and wakes the subscribers.
    ///
    /// # Errors
    /// [`PortError`] with iceoryx2's reason.
    pub fn send_loan(&self, mut loan: Loan<T>, header: T::Header) -> Result<(), PortError> {
        let topic = T::NAME;
        *loan.sample.user_header_mut() = header;
        // SAFETY: as in `Loan::items_mut`: every byte of mapped memory has a value, valid for a
        // `Pod`.
        let sample = unsafe { loan.sample.assume_init() };
        sample.send().map_err(|reason| PortError::Send { topic, reason })?;
        self.counters.add_published(1);
        let woken = self.notifier.notify();
        woken.map_err(|reason| PortError::WakeUp { topic, reason })?;
        Ok(())
    }

    /// Publishes a small message by copying it.
    ///
    /// # Errors
    /// As [`Publisher::loan`] and [`Publisher::send_loan`].
    pub fn send(&self, header: T::Header, items: &[T::Item]) -> Result<(), PortError> {
        let mut loan = self.loan(items.len())?;
        loan.items_mut().copy_from_slice(items);
        self.send_loan(loan, header)
    }

    /// Updates the connections to subscribers: those that joined since the last message get the
    /// topic's history.
    ///
    /// # Errors
    /// [`PortError`] with iceoryx2's reason.
    pub fn update_connections(&self) -> Result<(), PortError> {
        self.publisher
            .update_connections()
            .map_err(|reason| PortError::PublisherConnection { topic: T::NAME, reason })
    }
}

/// A message that is being written, in shared memory. Dropped, it is not sent.
pub struct Loan<T: Topic> {
    sample: SampleMutUninit<Service, [MaybeUninit<T::Item>], T::Header>,
}

impl<T: Topic> Loan<T> {
    /// The items; at first they have the earlier content of the memory.
    pub fn items_mut(&mut self) -> &mut [T::Item] {
        let items = self.sample.payload_mut();
        // SAFETY: the memory is a mapped file, so every byte has a value, and every value is valid
        // for an `Item`, which is `Pod`. The layout of `MaybeUninit<Item>` is that of `Item`.
        unsafe { &mut *(std::ptr::from_mut(items) as *mut [T::Item]) }
    }
}
