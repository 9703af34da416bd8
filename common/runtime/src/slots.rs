//! Messages that wait for a slow receiver, such as the network.
//!
//! There is one slot for each key: a newer message replaces one that still waits. So no more
//! messages wait than there are keys. After a stall the receiver gets current messages, not old
//! ones.

use std::collections::VecDeque;
use std::sync::{Condvar, Mutex, PoisonError};
use std::time::Duration;

use crate::lock::lock;

/// Messages between a caller that never waits and the thread that forwards them.
#[derive(Debug)]
pub struct Slots<K, V> {
    state: Mutex<State<K, V>>,
    changed: Condvar,
}

#[derive(Debug)]
struct State<K, V> {
    /// At most one for each key, first in first out by key, so that no key starves another.
    waiting: VecDeque<(K, V)>,
    overwritten: u64,
    is_closed: bool,
}

impl<K, V> Default for Slots<K, V> {
    fn default() -> Self {
        let state = State { waiting: VecDeque::new(), overwritten: 0, is_closed: false };
        Self { state: Mutex::new(state), changed: Condvar::new() }
    }
}

impl<K: PartialEq, V> Slots<K, V> {
    /// Puts a message in and returns at once.
    ///
    /// # Errors
    /// The slots are closed: the message comes back.
    pub fn put(&self, key: K, value: V) -> Result<(), V> {
        let mut state = lock(&self.state);
        if state.is_closed {
            return Err(value);
        }
        match state.waiting.iter_mut().find(|(waiting, _)| *waiting == key) {
            Some((_, waiting)) => {
                *waiting = value;
                state.overwritten += 1;
            }
            None => state.waiting.push_back((key, value)),
        }
        drop(state);
        self.changed.notify_all();
        Ok(())
    }

    /// Waits for the next message; none once the slots are closed and empty.
    pub fn take(&self) -> Option<(K, V)> {
        let mut state = lock(&self.state);
        loop {
            if let Some(next) = state.waiting.pop_front() {
                return Some(next);
            }
            if state.is_closed {
                return None;
            }
            state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Waits for `period`; returns true as soon as the slots are closed.
    pub fn wait_closed(&self, period: Duration) -> bool {
        let state = lock(&self.state);
        let waited = self.changed.wait_timeout_while(state, period, |state| !state.is_closed);
        waited.unwrap_or_else(PoisonError::into_inner).0.is_closed
    }

    /// Messages that a newer one replaced before they were taken.
    pub fn overwritten(&self) -> u64 {
        lock(&self.state).overwritten
    }

    /// Closes the slots; waiting messages can still be taken.
    pub fn close(&self) {
        lock(&self.state).is_closed = true;
        self.changed.notify_all();
    }

    /// Whether the slots accept nothing more.
    pub fn is_closed(&self) -> bool {
        lock(&self.state).is_closed
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    #[test]
    fn the_newest_of_each_key_remains_and_the_rest_is_counted() {
        let slots = Slots::default();
        for number in 1..=3 {
            ["/tf", "/pose"].into_iter().for_each(|key| slots.put(key, number).unwrap());
        }
        assert_eq!(slots.overwritten(), 4);
        slots.close();
        let taken: Vec<_> = std::iter::from_fn(|| slots.take()).collect();
        assert_eq!(taken, [("/tf", 3), ("/pose", 3)]);
        assert_eq!(slots.put("/tf", 4), Err(4));
    }

    #[test]
    fn closing_ends_a_wait() {
        let slots = Slots::<u8, u8>::default();
        assert!(!slots.wait_closed(Duration::from_millis(1)));
        std::thread::scope(|scope| {
            let waiting = scope.spawn(|| slots.wait_closed(Duration::MAX));
            let taking = scope.spawn(|| slots.take());
            slots.close();
            assert!(waiting.join().expect("no panic"));
            assert_eq!(taking.join().expect("no panic"), None);
        });
        assert!(slots.is_closed());
    }
}
