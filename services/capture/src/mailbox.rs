//! Mailbox from the decoder's thread to the consumer.

use std::collections::VecDeque;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use flockeye_config::Flow;
use flockeye_runtime::lock::lock;

/// Result of [`Mailbox::take`].
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum MailboxContent<T, F> {
    Item(T),
    /// End of the stream.
    Ended,
    /// Failure, after all items before it were taken.
    Failed(F),
    /// No item before the timeout.
    TimedOut,
}

/// Timeout for the end of the stream after an error. Errors arrive before the frames that were
/// decoded earlier; the end arrives after them.
const GRACE: Duration = Duration::from_secs(1);

/// Items `T` and at most one failure `F`, from the decoder's threads to the consumer's.
#[derive(Debug)]
pub(crate) struct Mailbox<T, F> {
    room: usize,
    flow: Flow,
    state: Mutex<MailboxState<T, F>>,
    changed: Condvar,
}

#[derive(Debug)]
struct MailboxState<T, F> {
    queue: VecDeque<T>,
    ready: bool,
    ended: bool,
    closed: bool,
    failure: Option<(F, Instant)>,
}

impl<T, F: Clone> Mailbox<T, F> {
    /// A mailbox for `room` items (at least one). If it is full, a new item replaces the oldest
    /// one; in lossless flow the decoder waits.
    pub(crate) fn new(room: usize, flow: Flow) -> Self {
        let state = MailboxState {
            queue: VecDeque::new(),
            ready: false,
            ended: false,
            closed: false,
            failure: None,
        };
        Self { room: room.max(1), flow, state: Mutex::new(state), changed: Condvar::new() }
    }

    /// Adds an item. Returns false if the mailbox is closed.
    pub(crate) fn put(&self, item: T) -> bool {
        let mut state = self.lock();
        while state.queue.len() >= self.room && !state.closed {
            match self.flow {
                Flow::Latest => drop(state.queue.pop_front()),
                Flow::Lossless => {
                    state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner)
                }
            }
        }
        if state.closed {
            return false;
        }
        state.queue.push_back(item);
        self.changed.notify_all();
        true
    }

    /// Notes that the first frame is decoded and waits at the sink.
    pub(crate) fn set_ready(&self) {
        self.lock().ready = true;
        self.changed.notify_all();
    }

    /// Notes the end of the stream.
    pub(crate) fn end(&self) {
        self.lock().ended = true;
        self.changed.notify_all();
    }

    /// Notes a failure. Only the first one is kept: later ones follow from it.
    pub(crate) fn fail(&self, failure: F) {
        self.lock().failure.get_or_insert_with(|| (failure, Instant::now()));
        self.changed.notify_all();
    }

    /// Closes the mailbox, and wakes all threads that wait in [`Self::put`].
    pub(crate) fn close(&self) {
        let mut state = self.lock();
        state.closed = true;
        state.queue.clear();
        self.changed.notify_all();
    }

    /// Takes an item. Waits for at most `timeout`.
    pub(crate) fn take(&self, timeout: Duration) -> MailboxContent<T, F> {
        let deadline = Instant::now() + timeout;
        let mut state = self.lock();
        loop {
            if let Some(item) = state.queue.pop_front() {
                self.changed.notify_all();
                return MailboxContent::Item(item);
            }
            let mut until = deadline;
            match (&state.failure, state.ended) {
                (None, true) => return MailboxContent::Ended,
                (Some((failure, _)), true) => return MailboxContent::Failed(failure.clone()),
                (Some((failure, since)), false) if since.elapsed() >= GRACE => {
                    return MailboxContent::Failed(failure.clone());
                }
                (Some((_, since)), false) => until = until.min(*since + GRACE),
                (None, false) => {}
            }
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() && until == deadline {
                return MailboxContent::TimedOut;
            }
            state = self.wait(state, left);
        }
    }

    /// Waits until the first frame is decoded. Returns false after `timeout`, or the failure.
    pub(crate) fn wait_ready(&self, timeout: Duration) -> Result<bool, F> {
        let deadline = Instant::now() + timeout;
        let mut state = self.lock();
        loop {
            if let Some((failure, _)) = &state.failure
                && !state.ready
            {
                return Err(failure.clone());
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if state.ready || left.is_zero() {
                return Ok(state.ready);
            }
            state = self.wait(state, left);
        }
    }

    fn lock(&self) -> MutexGuard<'_, MailboxState<T, F>> {
        // No code that can panic runs under this lock, so the state is consistent.
        lock(&self.state)
    }

    fn wait<'a>(
        &self,
        state: MutexGuard<'a, MailboxState<T, F>>,
        time: Duration,
    ) -> MutexGuard<'a, MailboxState<T, F>> {
        self.changed.wait_timeout(state, time).unwrap_or_else(PoisonError::into_inner).0
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use std::sync::Arc;

    const NOW: Duration = Duration::ZERO;
    const LONG: Duration = Duration::from_secs(20);

    fn mailbox(flow: Flow) -> Mailbox<u32, &'static str> {
        Mailbox::new(2, flow)
    }

    #[test]
    fn the_newest_replace_the_oldest() {
        let mailbox = mailbox(Flow::Latest);
        (0..5).for_each(|k| assert!(mailbox.put(k)));
        mailbox.end();
        let taken: Vec<_> = (0..3).map(|_| mailbox.take(NOW)).collect();
        assert_eq!(
            taken,
            [MailboxContent::Item(3), MailboxContent::Item(4), MailboxContent::Ended]
        );
    }

    #[test]
    fn a_held_back_decoder_loses_nothing() {
        let mailbox = Arc::new(mailbox(Flow::Lossless));
        let decoder = std::thread::spawn({
            let mailbox = Arc::clone(&mailbox);
            move || {
                (0..50).for_each(|k| assert!(mailbox.put(k)));
                mailbox.end();
            }
        });
        for k in 0..50 {
            assert_eq!(mailbox.take(LONG), MailboxContent::Item(k));
        }
        assert_eq!(mailbox.take(LONG), MailboxContent::Ended);
        decoder.join().unwrap();
    }

    #[test]
    fn closing_frees_a_held_back_decoder() {
        let mailbox = Arc::new(mailbox(Flow::Lossless));
        let decoder = std::thread::spawn({
            let mailbox = Arc::clone(&mailbox);
            move || (0..).any(|k| !mailbox.put(k))
        });
        mailbox.close();
        assert!(decoder.join().unwrap());
    }

    #[test]
    fn a_failure_waits_for_the_frames_before_it() {
        let mailbox = mailbox(Flow::Lossless);
        mailbox.fail("cause");
        mailbox.fail("echo");
        assert_eq!(mailbox.take(NOW), MailboxContent::TimedOut);
        assert!(mailbox.put(7));
        mailbox.end();
        assert_eq!(mailbox.take(NOW), MailboxContent::Item(7));
        assert_eq!(mailbox.take(NOW), MailboxContent::Failed("cause"));
        assert_eq!(mailbox.take(NOW), MailboxContent::Failed("cause"));
    }

    #[test]
    fn a_failure_without_an_end_is_told_all_the_same() {
        let mailbox = mailbox(Flow::Lossless);
        mailbox.fail("cause");
        assert_eq!(mailbox.take(LONG), MailboxContent::Failed("cause"));
        assert_eq!(mailbox.wait_ready(LONG), Err("cause"));
    }
}
