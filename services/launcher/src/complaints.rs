//! Consequences of complaints that stages send about other stages.

use std::time::{Duration, Instant};

/// Number of consecutive unanswered views after which a worker is replaced.
///
/// The first silence already excludes the worker from the rotation, so the flight does not wait for
/// this. A worker on a busy machine is late now and then. Three timeouts of
/// `rectification.overdue_ms` in a row are no accident.
pub(crate) const MOST_SILENCES: u64 = 3;
/// Number of refused messages after which a process is replaced.
pub(crate) const MOST_REFUSED: u64 = 30;
/// Number of replacements for bad messages after which a worker rests before its next start.
const REPLACEMENTS_BEFORE_REST: usize = 3;
/// Age after which a replacement no longer counts.
const MEMORY: Duration = Duration::from_secs(60);
/// Rest of a worker before its next start.
///
/// A wrong program stays wrong, and each start costs up to three unanswered views. A machine that
/// was overloaded recovers, and needs its workers again. So no worker is given up for good. A wrong
/// program is tried twice a minute.
const REST: Duration = Duration::from_secs(30);

/// Notes a replacement of a worker at `now`. `replaced` holds the times of earlier replacements for
/// bad messages. Returns the rest before the next start, if one is due.
pub(crate) fn rest_before_next(replaced: &mut Vec<Instant>, now: Instant) -> Option<Duration> {
    replaced.retain(|&then| now.saturating_duration_since(then) < MEMORY);
    replaced.push(now);
    (replaced.len() > REPLACEMENTS_BEFORE_REST).then_some(REST)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_is_bad_four_times_in_a_minute_rests_and_then_has_one_try() {
        let mut replaced = Vec::new();
        let start = Instant::now();
        let mut after = |s| rest_before_next(&mut replaced, start + Duration::from_secs(s));
        for s in 0..3 {
            assert_eq!(after(s), None);
        }
        assert_eq!(after(10), Some(REST));
        assert_eq!(after(45), Some(REST), "bad again after its rest");
        assert_eq!(after(200), None, "it was good for two minutes");
    }
}
