//! The bounded queue from the receiving thread to the writing thread.

use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

use flockeye_recording::losses::Loss;
use flockeye_runtime::lock::lock;

use crate::message::TopicMessage;

/// Maximum wait of the consumer between wake-ups: a wake-up per message needs more processor time.
const GATHER: Duration = Duration::from_millis(50);

/// Both ends of the queue.
#[derive(Debug, Clone)]
pub(crate) struct WriteQueue {
    shared: Arc<(Mutex<State>, Condvar)>,
    most_bytes: usize,
}

#[derive(Debug, Default)]
struct State {
    entries: VecDeque<TopicMessage>,
    bytes: usize,
    losses: Vec<Loss>,
    is_closed: bool,
    /// Whether a request to write the ring is pending.
    is_asked: bool,
}

/// Result of [`WriteQueue::take`].
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Taken {
    Message(TopicMessage),
    /// Timeout, or a pending request.
    Nothing,
    /// The queue is closed and empty.
    End,
}

impl WriteQueue {
    pub(crate) fn new(most_bytes: usize, topics: usize) -> Self {
        let state = State { losses: vec![Loss::default(); topics], ..State::default() };
        Self { shared: Arc::new((Mutex::new(state), Condvar::new())), most_bytes }
    }

    /// Adds a message. If the queue is full, the message is dropped and counted as lost.
    pub(crate) fn push(&self, entry: TopicMessage) {
        let (topic, bytes) = (entry.topic, entry.bytes());
        let is_urgent = self.with(|state| {
            let is_full = state.bytes + bytes > self.most_bytes && !state.entries.is_empty();
            if let Some(loss) = state.losses.get_mut(topic) {
                loss.recorded += u64::from(!is_full);
                loss.queue_full += u64::from(is_full);
            }
            if !is_full {
                state.bytes += bytes;
                state.entries.push_back(entry);
            }
            state.bytes > self.most_bytes / 4
        });
        if is_urgent {
            self.shared.1.notify_one();
        }
    }

    /// Whether topics with waiting senders may be received. Half of the room is reserved for other
    /// topics.
    pub(crate) fn has_room(&self) -> bool {
        self.with(|state| state.bytes <= self.most_bytes / 2)
    }

    /// Changes the losses of a topic.
    pub(crate) fn note(&self, topic: usize, note: impl FnOnce(&mut Loss)) {
        self.with(|state| {
            if let Some(loss) = state.losses.get_mut(topic) {
                note(loss);
            }
        });
    }

    /// Recorded and lost messages of each topic until now.
    pub(crate) fn losses(&self) -> Vec<Loss> {
        self.with(|state| state.losses.clone())
    }

    pub(crate) fn ask(&self) {
        self.with(|state| state.is_asked = true);
        self.shared.1.notify_one();
    }

    /// Whether a request has come since the last call.
    pub(crate) fn take_request(&self) -> bool {
        self.with(|state| std::mem::take(&mut state.is_asked))
    }

    /// Closes the queue, from either end.
    pub(crate) fn close(&self) {
        self.with(|state| state.is_closed = true);
        self.shared.1.notify_one();
    }

    pub(crate) fn is_closed(&self) -> bool {
        self.with(|state| state.is_closed)
    }

    /// Takes the next message. Waits until the time `until` or a request, so several messages may
    /// be queued on return.
    pub(crate) fn take(&self, until: Instant) -> Taken {
        let (mutex, condition) = &*self.shared;
        let mut state = lock(mutex);
        loop {
            if let Some(entry) = state.entries.pop_front() {
                state.bytes -= entry.bytes();
                return Taken::Message(entry);
            }
            if state.is_closed {
                return Taken::End;
            }
            let wait = until.saturating_duration_since(Instant::now());
            if wait == Duration::ZERO || state.is_asked {
                return Taken::Nothing;
            }
            let waited = condition.wait_timeout(state, wait.min(GATHER));
            state = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    fn with<R>(&self, change: impl FnOnce(&mut State) -> R) -> R {
        change(&mut lock(&self.shared.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockeye_recording::ContractMessage;

    fn entry(topic: usize, at_ns: i64, bytes: usize) -> TopicMessage {
        let message = ContractMessage { header: vec![0; bytes], ..ContractMessage::default() };
        TopicMessage { topic, at_ns, message, pixels: None }
    }

    #[test]
    fn what_finds_no_room_is_counted_and_the_rest_keeps_its_order() {
        let queue = WriteQueue::new(1_000, 2);
        for at_ns in 0..5 {
            queue.push(entry(1, at_ns, 272));
        }
        let [none, some] = queue.losses().try_into().expect("two topics");
        assert!(none.lost() == 0);
        assert_eq!((some.recorded, some.queue_full), (2, 3));
        let soon = Instant::now();
        assert!(!queue.has_room());
        assert_eq!(queue.take(soon), Taken::Message(entry(1, 0, 272)));
        assert!(queue.has_room());
        // There is room again; and one that is larger than the queue goes through an empty one.
        queue.push(entry(1, 9, 100));
        assert_eq!(queue.take(soon), Taken::Message(entry(1, 1, 272)));
        assert_eq!(queue.take(soon), Taken::Message(entry(1, 9, 100)));
        assert_eq!(queue.take(soon), Taken::Nothing);
        queue.push(entry(0, 10, 5_000));
        queue.close();
        assert_eq!(queue.take(soon), Taken::Message(entry(0, 10, 5_000)));
        assert_eq!(queue.take(soon), Taken::End);
    }
}
