//! Messages that wait to be sent.
//!
//! There is one slot for each topic: a newer message replaces one that has not been sent. So the outbox
//! is bounded, as topics are, and after a stall it sends current messages, not old ones.

use std::{
    collections::VecDeque,
    sync::{Condvar, Mutex, PoisonError},
    time::Duration,
};

use crate::error::Ros2Error;
use crate::lock::lock;
use crate::messages::MessageType;

/// A topic and what is published on it.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Topic {
    /// Its name, beginning with '/'.
    pub(crate) name: String,
    pub(crate) message: MessageType,
}

/// A message on its way.
#[derive(Debug)]
pub(crate) struct Outgoing {
    pub(crate) topic: Topic,
    /// Its CDR bytes.
    pub(crate) payload: Vec<u8>,
}

/// Messages between the caller and the thread that sends.
#[derive(Debug, Default)]
pub(crate) struct Outbox {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct State {
    /// At most one for each topic, first in first out by topic, so that no topic starves another.
    pending: VecDeque<Outgoing>,
    overwritten: u64,
    closed: bool,
}

impl Outbox {
    /// Puts a message in and returns at once.
    pub(crate) fn put(&self, outgoing: Outgoing) -> Result<(), Ros2Error> {
        let mut state = lock(&self.state);
        if state.closed {
            return Err(Ros2Error::Closed);
        }
        match state.pending.iter_mut().find(|waiting| waiting.topic == outgoing.topic) {
            Some(waiting) => {
                *waiting = outgoing;
                state.overwritten += 1;
            }
            None => state.pending.push_back(outgoing),
        }
        drop(state);
        self.changed.notify_one();
        Ok(())
    }

    /// Waits for the next message to send; none once closed and empty.
    pub(crate) fn take(&self) -> Option<Outgoing> {
        let mut state = lock(&self.state);
        loop {
            if let Some(outgoing) = state.pending.pop_front() {
                return Some(outgoing);
            }
            if state.closed {
                return None;
            }
            state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Waits for `period`; returns true as soon as the outbox is closed.
    pub(crate) fn wait_closed(&self, period: Duration) -> bool {
        let state = lock(&self.state);
        let waited = self.changed.wait_timeout_while(state, period, |state| !state.closed);
        waited.unwrap_or_else(PoisonError::into_inner).0.closed
    }

    /// Messages that a newer one replaced before they were sent.
    pub(crate) fn overwritten(&self) -> u64 {
        lock(&self.state).overwritten
    }

    /// Accepts nothing more; waiting messages are still sent.
    pub(crate) fn close(&self) {
        lock(&self.state).closed = true;
        self.changed.notify_all();
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    fn outgoing(name: &str, byte: u8) -> Outgoing {
        let topic = Topic { name: name.into(), message: MessageType::TfMessage };
        Outgoing { topic, payload: vec![byte] }
    }

    #[test]
    fn while_nothing_is_sent_the_newest_of_each_topic_remains_and_the_rest_is_counted() {
        let outbox = Outbox::default();
        for byte in 1..=3 {
            ["/tf", "/pose"].into_iter().for_each(|name| outbox.put(outgoing(name, byte)).unwrap());
        }
        assert_eq!(outbox.overwritten(), 4);
        outbox.close();
        let sent: Vec<_> = std::iter::from_fn(|| outbox.take())
            .map(|outgoing| (outgoing.topic.name, outgoing.payload))
            .collect();
        assert_eq!(sent, [("/tf".to_owned(), vec![3]), ("/pose".to_owned(), vec![3])]);
    }

    #[test]
    fn closing_ends_a_wait() {
        let outbox = Outbox::default();
        assert!(!outbox.wait_closed(Duration::from_millis(1)));
        std::thread::scope(|scope| {
            let waiting = scope.spawn(|| outbox.wait_closed(Duration::MAX));
            outbox.close();
            assert!(waiting.join().expect("no panic"));
        });
        assert!(outbox.take().is_none());
        assert!(matches!(outbox.put(outgoing("/tf", 1)), Err(Ros2Error::Closed)));
    }
}
