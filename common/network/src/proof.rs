//! Whether an observer is there now, where reports are signed.
//!
//! A signature says who said something, and not when. Whoever recorded a drone's reports could play them while it is
//! away, and its clock may be anything. So an observer that was not heard for a while must first answer a question
//! that nobody could foresee; from then on what it says must be newer than its answer.

use std::time::{Duration, Instant};

/// An observer that is there has answered by then, also over a bad radio.
const PATIENCE: Duration = Duration::from_secs(2);

/// What is known of one observer.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Proof {
    /// When it answered last, by its own clock, UTC in nanoseconds.
    answered_utc_ns: Option<i64>,
    /// Since when what comes in its name has no such answer before it.
    waiting_since: Option<Instant>,
}

/// What is said cannot be told from something recorded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum NotProven {
    /// The answer may still come.
    Waiting,
    /// It should have come long ago.
    Overdue,
}

impl Proof {
    /// Whether an answer has come.
    pub(crate) fn is_proven(&self) -> bool {
        self.answered_utc_ns.is_some()
    }

    /// The observer was silent for a while: it must answer again.
    pub(crate) fn forget(&mut self) {
        self.answered_utc_ns = None;
    }

    /// The observer has answered at this time of its own clock.
    pub(crate) fn answered(&mut self, utc_ns: i64) {
        *self = Self { answered_utc_ns: Some(utc_ns), waiting_since: None };
    }

    /// When it answered; the error where something is said before an answer.
    pub(crate) fn check(&mut self, now: Instant) -> Result<i64, NotProven> {
        if let Some(answered) = self.answered_utc_ns {
            return Ok(answered);
        }
        let since = *self.waiting_since.get_or_insert(now);
        Err(if now.saturating_duration_since(since) < PATIENCE {
            NotProven::Waiting
        } else {
            NotProven::Overdue
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_is_believed_before_an_answer_and_silence_asks_for_another() {
        let (mut proof, start) = (Proof::default(), Instant::now());
        assert_eq!(proof.check(start), Err(NotProven::Waiting));
        assert_eq!(proof.check(start + PATIENCE), Err(NotProven::Overdue));
        proof.answered(7);
        assert_eq!(proof.check(start + PATIENCE), Ok(7));
        proof.forget();
        assert!(!proof.is_proven());
        let again = proof.check(start + 9 * PATIENCE);
        assert_eq!(again, Err(NotProven::Waiting), "it is waited for anew");
    }
}
