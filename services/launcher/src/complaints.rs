//! What stages have said of others, and what follows from it.

use std::time::{Duration, Instant};

/// A worker that has answered nothing so often, one time after the other, is replaced.
///
/// The first silence already keeps it out of rotation, so the flight does not wait for this. A worker on a
/// busy machine answers late now and then; three times in a row, each after `rectification.overdue_ms`, is
/// no accident.
pub const MOST_SILENCES: u64 = 3;
/// A process of which so many messages were refused is replaced.
pub const MOST_REFUSED: u64 = 30;
/// A worker that was replaced so often for its messages, each time soon after it had started, is given up.
const MOST_REPLACEMENTS: usize = 3;
/// What happened longer ago than this no longer counts.
const MEMORY: Duration = Duration::from_secs(60);

/// How often a worker was replaced because of what it sent.
#[derive(Debug, Default)]
pub struct Replacements(Vec<Instant>);

impl Replacements {
    /// Notes one more at `now`, and says whether it is worthwhile to try again.
    pub fn may_try_again(&mut self, now: Instant) -> bool {
        self.0.retain(|&then| now.saturating_duration_since(then) < MEMORY);
        self.0.push(now);
        self.0.len() <= MOST_REPLACEMENTS
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_fourth_replacement_in_a_minute_is_not_worthwhile() {
        let mut replacements = Replacements::default();
        let start = Instant::now();
        let at = |s| start + Duration::from_secs(s);
        for s in 0..3 {
            assert!(replacements.may_try_again(at(s)));
        }
        assert!(!replacements.may_try_again(at(10)));
        assert!(replacements.may_try_again(at(200)));
    }
}
