//! Requests of a page to the player of its recording.

use std::collections::VecDeque;
use std::sync::{Condvar, Mutex, PoisonError};
use std::time::Duration;

use flockeye_runtime::lock::lock;

/// Maximum requests that wait. A page that sends more does not wait for answers.
const MOST_WISHES: usize = 64;
/// Maximum frames of one step.
const MOST_STEPS: i32 = 1000;
/// Maximum speed of playback, recorded seconds per second.
const MAX_SPEED: f64 = 100.0;

/// A request of a page to the player of its recording.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Move {
    /// Shows this time, seconds from the beginning.
    Seek(f64),
    /// Shows the frame this many frames on, or back if negative.
    Step(i32),
    /// Plays at this speed, recorded seconds per second; 0 stops.
    Play(f64),
}

impl Move {
    /// Returns the message within its bounds.
    fn bounded(self) -> Self {
        match self {
            Self::Seek(to_s) => Self::Seek(to_s.clamp(0.0, 1e9)),
            Self::Step(frames) => Self::Step(frames.clamp(-MOST_STEPS, MOST_STEPS)),
            Self::Play(speed) => Self::Play(speed.clamp(0.0, MAX_SPEED)),
        }
    }
}

/// Requests of one page, which its socket's thread and its player share.
#[derive(Debug, Default)]
pub(crate) struct Remote {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct State {
    wishes: VecDeque<Move>,
    /// Number of requests that were taken or dropped.
    answers: u64,
    is_closed: bool,
}

impl Remote {
    /// Adds a request. A seek replaces the seek directly before it.
    pub(crate) fn ask(&self, wish: Move) {
        let wish = wish.bounded();
        let mut state = lock(&self.state);
        let is_seek = |wish: &Move| matches!(wish, Move::Seek(_));
        if is_seek(&wish) && state.wishes.back().is_some_and(is_seek) {
            state.wishes.pop_back();
            state.answers += 1;
        }
        if state.wishes.len() >= MOST_WISHES {
            state.wishes.pop_front();
            state.answers += 1;
        }
        state.wishes.push_back(wish);
        self.changed.notify_all();
    }

    /// Wakes the player after another change of the page.
    pub(crate) fn wake(&self) {
        self.changed.notify_all();
    }

    pub(crate) fn close(&self) {
        lock(&self.state).is_closed = true;
        self.changed.notify_all();
    }

    pub(crate) fn is_closed(&self) -> bool {
        lock(&self.state).is_closed
    }

    /// The next request, and the number of requests done with it. Waits at most `at_most`; none
    /// without a request, and where the page is closed ([`is_closed`](Self::is_closed)).
    pub(crate) fn next(&self, at_most: Duration) -> Option<(Move, u64)> {
        let mut state = lock(&self.state);
        if state.wishes.is_empty() && !state.is_closed && !at_most.is_zero() {
            let waited = self.changed.wait_timeout(state, at_most);
            state = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
        if state.is_closed {
            return None;
        }
        let wish = state.wishes.pop_front()?;
        state.answers += 1;
        Some((wish, state.answers))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_last_of_many_seeks_counts_and_all_are_answered() {
        let remote = Remote::default();
        assert_eq!(remote.next(Duration::ZERO), None);
        for to_s in [1.0, -5.0, 1e300, 7.0] {
            remote.ask(Move::Seek(to_s));
        }
        remote.ask(Move::Play(1e9));
        remote.ask(Move::Seek(-3.0));
        remote.ask(Move::Step(i32::MIN));
        assert_eq!(remote.next(Duration::ZERO), Some((Move::Seek(7.0), 4)));
        assert_eq!(remote.next(Duration::ZERO), Some((Move::Play(MAX_SPEED), 5)));
        assert_eq!(remote.next(Duration::ZERO), Some((Move::Seek(0.0), 6)));
        assert_eq!(remote.next(Duration::ZERO), Some((Move::Step(-MOST_STEPS), 7)));
        for _ in 0..10_000 {
            remote.ask(Move::Step(1));
        }
        let mut last = 0;
        while let Some((_, answers)) = remote.next(Duration::ZERO) {
            last = answers;
        }
        assert_eq!(last, 10_007);
        remote.ask(Move::Step(1));
        remote.close();
        assert_eq!(remote.next(Duration::from_secs(60)), None);
        assert!(remote.is_closed());
    }
}
