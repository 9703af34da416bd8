//! How long an observer has been waited for, where reports are signed.
//!
//! A signature says who said something, and not when. Whoever recorded a drone's reports could play
//! them while it is away, and its clock may be anything. So an observer that was not heard for a
//! while must first answer a question that nobody could foresee; from then on what it says must be
//! newer than its answer ([`Freshness`](crate::freshness::Freshness)).

use std::time::{Duration, Instant};

/// An observer that is there has answered by then, also over a bad radio.
const PATIENCE: Duration = Duration::from_secs(2);
/// After so long without a word in its name it is waited for anew: nobody had asked it meanwhile.
const ANEW_AFTER: Duration = Duration::from_secs(3);

/// What came in an observer's name before its answer: the first and the last of it.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Waiting(Option<(Instant, Instant)>);

impl Waiting {
    /// Something more has come. Whether the answer should have come long ago.
    pub(crate) fn is_overdue(&mut self, now: Instant) -> bool {
        let first = match self.0 {
            Some((first, last)) if now.saturating_duration_since(last) < ANEW_AFTER => first,
            _ => now,
        };
        self.0 = Some((first, now));
        now.saturating_duration_since(first) >= PATIENCE
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_does_not_answer_is_overdue_until_it_falls_silent() {
        let (mut waiting, start) = (Waiting::default(), Instant::now());
        let overdue: Vec<bool> =
            (0..6).map(|k| waiting.is_overdue(start + Duration::from_millis(500) * k)).collect();
        assert_eq!(overdue, [false, false, false, false, true, true]);
        assert!(!waiting.is_overdue(start + Duration::from_secs(60)), "it is asked anew");
    }
}
