//! Timeout of an observer's first answer, where reports are signed.
//!
//! A signature proves the origin of a message, but not its time. An attacker could replay a drone's
//! recorded reports while it is away, and its clock may show any time. So after a silence an
//! observer must first answer a query with a random challenge. From then on its reports must be
//! newer than its answer ([`Freshness`](crate::freshness::Freshness)).

use std::time::{Duration, Instant};

/// Timeout of an answer; a present observer answers sooner, also over a bad radio.
const PATIENCE: Duration = Duration::from_secs(2);
/// Silence after which the timeout starts anew, because there was no query meanwhile.
const ANEW_AFTER: Duration = Duration::from_secs(3);

/// Notes another message before the observer's answer, and returns whether the answer is overdue.
/// `unanswered` holds the arrival of the first and of the last of these messages.
pub(crate) fn is_overdue(unanswered: &mut Option<(Instant, Instant)>, now: Instant) -> bool {
    let first = match *unanswered {
        Some((first, last)) if now.saturating_duration_since(last) < ANEW_AFTER => first,
        _ => now,
    };
    *unanswered = Some((first, now));
    now.saturating_duration_since(first) >= PATIENCE
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_does_not_answer_is_overdue_until_it_falls_silent() {
        let (mut waiting, start) = (None, Instant::now());
        let overdue: Vec<bool> = (0..6)
            .map(|k| is_overdue(&mut waiting, start + Duration::from_millis(500) * k))
            .collect();
        assert_eq!(overdue, [false, false, false, false, true, true]);
        assert!(!is_overdue(&mut waiting, start + Duration::from_secs(60)), "it is asked anew");
    }
}
