//! When the next frame is due, and what still fits before it.
//!
//! What is left of a frame's time is for searching partitions. A source that is late, because it
//! decodes or draws on the same processors, would be later still if the search went on until it came; and
//! its neighbours' views wait for a partition that is being cut when it comes.

use std::collections::VecDeque;

use flockeye_contract::FrameStamp;

/// Frames from which it is learnt: about a second.
const FRAMES: usize = 32;

/// The last cut's share in what cuts usually take.
const CUT_SHARE: f64 = 0.1;

/// What is left of the longest search after each partition: a slow one makes the next ten careful.
const FORGETTING: f64 = 0.9;

/// A worker that says that it searched a partition for longer is not believed, nanoseconds.
const LONGEST_SEARCH_NS: i64 = 1_000_000_000;

/// After so many frames in which there was time for neighbours only, one partition is cut all the same.
const MOST_SINCE_PARTITION: u32 = 4;

/// The frames of a source that came last, and what partitions took.
#[derive(Debug, Clone, Default)]
pub struct Cadence {
    frames: VecDeque<(FrameStamp, i64)>,
    cut_ns: f64,
    search_ns: f64,
    frames_since_partition: u32,
}

impl Cadence {
    /// A frame came at `received_ns`, CLOCK_MONOTONIC.
    pub fn note(&mut self, stamp: &FrameStamp, received_ns: i64) {
        let goes_on = |last: &FrameStamp| {
            let source = |stamp: &FrameStamp| (stamp.source_generation, stamp.epoch);
            source(last) == source(stamp) && last.sequence < stamp.sequence
        };
        if self.frames.back().is_some_and(|(last, _)| !goes_on(last)) {
            self.frames.clear();
        }
        if self.frames.len() == FRAMES {
            self.frames.pop_front();
        }
        self.frames.push_back((*stamp, received_ns));
    }

    /// A partition was cut.
    pub fn note_cut(&mut self, took_ns: i64) {
        self.cut_ns += CUT_SHARE * (took_ns as f64 - self.cut_ns);
    }

    /// A partition was searched, as its worker says.
    pub fn note_search(&mut self, took_ns: i64) {
        let took_ns = took_ns.clamp(0, LONGEST_SEARCH_NS) as f64;
        self.search_ns = (FORGETTING * self.search_ns).max(took_ns);
    }

    /// Whether a partition can be cut before the next frame is due, or nothing is known of that.
    pub fn has_time_to_cut(&self, now_ns: i64) -> bool {
        let cut_ns = now_ns.saturating_add(self.cut_ns as i64);
        self.due_ns().is_none_or(|due_ns| cut_ns < due_ns)
    }

    /// Whether a partition and the one that is being searched will both have been searched before the next
    /// frame is due.
    pub fn has_time_to_cut_ahead(&self, now_ns: i64) -> bool {
        let searched_ns = now_ns.saturating_add(2 * self.search_ns as i64);
        self.search_ns > 0.0 && self.due_ns().is_some_and(|due_ns| searched_ns < due_ns)
    }

    /// A frame has come to so many partitions, and is not cut further.
    pub fn note_end(&mut self, partitions: usize) {
        self.frames_since_partition = match partitions {
            0 => self.frames_since_partition.saturating_add(1),
            _ => 0,
        };
    }

    /// Whether the next frame has to come to a partition, however little time there is.
    pub fn owes_partition(&self) -> bool {
        self.frames_since_partition >= MOST_SINCE_PARTITION
    }

    /// When the frame after the last one will be here if it is as quick as the quickest lately,
    /// CLOCK_MONOTONIC, nanoseconds; `None` while that is not known.
    pub fn due_ns(&self) -> Option<i64> {
        let ((first, _), (last, _)) = (self.frames.front()?, self.frames.back()?);
        let frames = i64::try_from(last.sequence.checked_sub(first.sequence)?).ok()?;
        let interval_ns = last.exposure_ns.checked_sub(first.exposure_ns)?.checked_div(frames)?;
        let mut lags =
            self.frames.iter().map(|(stamp, at_ns)| at_ns.checked_sub(stamp.exposure_ns));
        let lag_ns = lags.try_fold(i64::MAX, |least_ns, lag_ns| Some(least_ns.min(lag_ns?)))?;
        let due_ns = last.exposure_ns.checked_add(interval_ns)?.checked_add(lag_ns)?;
        (interval_ns > 0).then_some(due_ns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    fn stamp(sequence: u64, exposure_ms: i64) -> FrameStamp {
        FrameStamp { sequence, exposure_ns: exposure_ms * MS, ..FrameStamp::default() }
    }

    fn cadence(frames: &[(u64, i64, i64)]) -> Cadence {
        let mut cadence = Cadence::default();
        for &(sequence, exposure_ms, received_ms) in frames {
            cadence.note(&stamp(sequence, exposure_ms), received_ms * MS);
        }
        cadence
    }

    #[test]
    fn a_frame_is_due_an_interval_after_the_last_as_quick_as_the_quickest() {
        let due_ms = |frames: &[_]| cadence(frames).due_ns().map(|due_ns| due_ns / MS);
        assert_eq!(due_ms(&[]), None);
        assert_eq!(due_ms(&[(0, 100, 104)]), None, "one says nothing of the rate");
        assert_eq!(due_ms(&[(0, 100, 104), (1, 130, 133)]), Some(163));
        assert_eq!(due_ms(&[(0, 100, 104), (1, 130, 160)]), Some(164), "a late one is no measure");
        assert_eq!(due_ms(&[(0, 100, 104), (3, 190, 194)]), Some(224), "two were dropped");
        assert_eq!(due_ms(&[(0, 100, 350), (1, 130, 380)]), Some(410), "a camera's latency");
    }

    #[test]
    fn it_is_learnt_anew_from_another_source_and_forgets_the_old() {
        let mut learnt = cadence(&[(0, 100, 104), (1, 130, 133)]);
        let restarted = FrameStamp { epoch: 1, ..stamp(0, 160) };
        learnt.note(&restarted, 170 * MS);
        assert_eq!(learnt.due_ns(), None);
        let first = (0u64, 0i64, 0i64);
        let later = (1..=FRAMES as u64).map(|n| (n, 30 * n as i64, 30 * n as i64 + 20));
        let frames: Vec<_> = std::iter::once(first).chain(later).collect();
        let last_ms = 30 * FRAMES as i64;
        assert_eq!(cadence(&frames[..FRAMES]).due_ns(), Some(last_ms * MS));
        assert_eq!(cadence(&frames).due_ns(), Some((last_ms + 30 + 20) * MS));
    }

    #[test]
    fn a_partition_that_would_not_be_cut_in_time_is_not_begun() {
        let mut unknown = Cadence::default();
        unknown.note_cut(5 * MS);
        assert!(unknown.has_time_to_cut(0));
        let mut due_at_160 = cadence(&[(0, 100, 100), (1, 130, 130)]);
        assert!(due_at_160.has_time_to_cut(159 * MS) && !due_at_160.has_time_to_cut(160 * MS));
        (0..100).for_each(|_| due_at_160.note_cut(5 * MS));
        assert!(due_at_160.has_time_to_cut(154 * MS) && !due_at_160.has_time_to_cut(156 * MS));
    }

    #[test]
    fn one_is_cut_ahead_while_two_can_be_searched_in_time() {
        let mut due_at_160 = cadence(&[(0, 100, 100), (1, 130, 130)]);
        assert!(!due_at_160.has_time_to_cut_ahead(130 * MS), "it is not known how long that takes");
        due_at_160.note_search(5 * MS);
        let is_ahead = |cadence: &Cadence, at_ms: i64| cadence.has_time_to_cut_ahead(at_ms * MS);
        assert!(is_ahead(&due_at_160, 149) && !is_ahead(&due_at_160, 150));
        due_at_160.note_search(10 * MS);
        assert!(is_ahead(&due_at_160, 139) && !is_ahead(&due_at_160, 141), "slow once");
        (0..10).for_each(|_| due_at_160.note_search(5 * MS));
        assert!(is_ahead(&due_at_160, 149), "forgotten");
        // Workers' words are not believed without bounds.
        due_at_160.note_search(i64::MAX);
        assert!(!is_ahead(&due_at_160, 130));
        (0..60).for_each(|_| due_at_160.note_search(i64::MIN));
        assert!(is_ahead(&due_at_160, 150));
        assert!(!cadence(&[]).has_time_to_cut_ahead(0));
    }

    #[test]
    fn after_some_frames_for_neighbours_only_a_partition_is_owed() {
        let mut busy = Cadence::default();
        (0..4).for_each(|_| {
            assert!(!busy.owes_partition());
            busy.note_end(0);
        });
        assert!(busy.owes_partition());
        busy.note_end(0);
        assert!(busy.owes_partition());
        busy.note_end(1);
        assert!(!busy.owes_partition());
    }

    #[test]
    fn clocks_that_mean_nothing_make_nothing_due() {
        assert_eq!(cadence(&[(0, 100, 104), (1, 100, 134)]).due_ns(), None, "it stands");
        assert_eq!(cadence(&[(0, 130, 104), (1, 100, 134)]).due_ns(), None, "it goes back");
        let mut wild = Cadence::default();
        for (sequence, exposure_ns) in [(0, i64::MIN), (u64::MAX, i64::MAX)] {
            wild.note(&FrameStamp { sequence, exposure_ns, ..FrameStamp::default() }, 5);
        }
        assert_eq!(wild.due_ns(), None);
    }
}
