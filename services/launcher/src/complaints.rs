//! What follows from complaints of stages about others.

use std::time::{Duration, Instant};

/// A worker that has left this many views without answer, one after the other, is replaced.
///
/// The first silence already keeps it out of rotation, so the flight does not wait for this. A
/// worker on a busy machine answers late now and then; three times in a row, each after
/// `rectification.overdue_ms`, is no accident.
pub(crate) const MOST_SILENCES: u64 = 3;
/// A process is replaced when this many of its messages were refused.
pub(crate) const MOST_REFUSED: u64 = 30;
/// A worker that was replaced this often for its messages rests before it is started again.
const REPLACEMENTS_BEFORE_REST: usize = 3;
/// A replacement that is longer ago than this no longer counts.
const MEMORY: Duration = Duration::from_secs(60);
/// How long a worker rests.
///
/// A program that is wrong stays wrong, and each start costs the flight up to three silences of its
/// views. A machine that was overloaded recovers, and must have its workers back. So nobody is
/// given up for good. A wrong program is tried twice a minute.
const REST: Duration = Duration::from_secs(30);

/// Notes one more replacement at `now` of a worker that was `replaced` for its messages at these
/// times. Returns how long it rests before it is started again; none: it does not rest.
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
