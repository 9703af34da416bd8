//! Prediction of the next frame's arrival, and of the work that fits before it.
//!
//! Tiles are searched in the remaining time of a frame. The source decodes or draws on the same
//! processors, so a search up to the next frame would delay it. Also, that frame's regions of
//! interest would wait for the last tile.

use std::collections::VecDeque;

use flockeye_contract::FrameStamp;

/// Number of frames for the estimate of the interval: about a second.
const FRAMES: usize = 32;

/// Weight of the last value in the moving average of the times of cuts and of proposal searches.
const CUT_SHARE: f64 = 0.1;

/// Decay of the maximum search time per tile: a slow search has an effect on about ten tiles.
const FORGETTING: f64 = 0.9;

/// Number of bursts after which further bursts are predicted.
const MIN_BURSTS: usize = 4;

/// Limit for a search time reported by a worker, nanoseconds.
const LONGEST_SEARCH_NS: i64 = 1_000_000_000;

/// The last frames of a source, and the times of cuts and searches.
#[derive(Debug, Clone, Default)]
pub(crate) struct Cadence {
    frames: VecDeque<(FrameStamp, i64)>,
    cut_ns: f64,
    look_ns: f64,
    search_ns: f64,
}

impl Cadence {
    /// Notes a frame that arrived at `received_ns`, CLOCK_MONOTONIC.
    pub(crate) fn note(&mut self, stamp: &FrameStamp, received_ns: i64) {
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

    /// Notes the time of a tile's cut.
    pub(crate) fn note_cut(&mut self, took_ns: i64) {
        self.cut_ns += CUT_SHARE * (took_ns as f64 - self.cut_ns);
    }

    /// Notes the time of a proposal search in the frame.
    pub(crate) fn note_look(&mut self, took_ns: i64) {
        self.look_ns += CUT_SHARE * (took_ns as f64 - self.look_ns);
    }

    /// Notes the search time of a tile, as its worker reports it.
    pub(crate) fn note_search(&mut self, took_ns: i64) {
        let took_ns = took_ns.clamp(0, LONGEST_SEARCH_NS) as f64;
        self.search_ns = (FORGETTING * self.search_ns).max(took_ns);
    }

    /// Whether a view can be cut before the next frame is due, with a proposal search before if
    /// needed. The estimate is for a tile, the largest kind of view. True while no estimate exists.
    pub(crate) fn has_time_to_cut(&self, needs_look: bool, now_ns: i64) -> bool {
        let look_ns = if needs_look { self.look_ns } else { 0.0 };
        let cut_ns = now_ns.saturating_add((look_ns + self.cut_ns) as i64);
        self.due_ns().is_none_or(|due_ns| cut_ns < due_ns)
    }

    /// Whether this tile and the one being searched will both be done before the next frame is due.
    pub(crate) fn has_time_to_cut_ahead(&self, now_ns: i64) -> bool {
        let searched_ns = now_ns.saturating_add(2 * self.search_ns as i64);
        self.search_ns > 0.0 && self.due_ns().is_some_and(|due_ns| searched_ns < due_ns)
    }

    /// Earliest arrival of the next frame, CLOCK_MONOTONIC, nanoseconds: with the minimum latency
    /// of the last frames. `None` while no estimate exists.
    pub(crate) fn due_ns(&self) -> Option<i64> {
        let ((first, _), (last, _)) = (self.frames.front()?, self.frames.back()?);
        let frames = i64::try_from(last.sequence.checked_sub(first.sequence)?).ok()?;
        let interval_ns = last.exposure_ns.checked_sub(first.exposure_ns)?.checked_div(frames)?;
        let mut lags =
            self.frames.iter().map(|(stamp, at_ns)| at_ns.checked_sub(stamp.exposure_ns));
        let lag_ns = lags.try_fold(i64::MAX, |least_ns, lag_ns| Some(least_ns.min(lag_ns?)))?;
        let due_ns = last.exposure_ns.checked_add(interval_ns)?.checked_add(lag_ns)?;
        let next_burst_ns = self.next_burst_ns(interval_ns).unwrap_or(i64::MIN);
        (interval_ns > 0).then_some(due_ns.max(next_burst_ns))
    }

    /// Start of the next burst, if frames of this interval arrive in bursts. The search then also
    /// uses the pause after a burst. `None` for a steady source.
    fn next_burst_ns(&self, interval_ns: i64) -> Option<i64> {
        let mut begun: Vec<i64> = Vec::new();
        let mut last_ns = None;
        for &(_, at_ns) in &self.frames {
            let gap_ns = last_ns.and_then(|last_ns| at_ns.checked_sub(last_ns));
            if gap_ns.is_none_or(|gap_ns| gap_ns > interval_ns / 2) {
                begun.push(at_ns);
            }
            last_ns = Some(at_ns);
        }
        let gaps = begun.windows(2).map(|pair| pair[1].saturating_sub(pair[0]));
        let shortest_ns = gaps.min().filter(|_| begun.len() >= MIN_BURSTS)?;
        let is_bursty = shortest_ns > interval_ns.saturating_add(interval_ns / 2);
        is_bursty.then(|| begun.last()?.checked_add(shortest_ns))?
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
    fn the_pause_after_a_burst_is_used() {
        // Two frames of 33 ms each come together, every 66 ms.
        let bursts: Vec<_> =
            (0..10).map(|n: i64| (n as u64, 33 * n, 66 * (n / 2) + 40 + n % 2)).collect();
        let due_ms = |frames: &[_]| cadence(frames).due_ns().map(|due_ns| due_ns / MS);
        assert_eq!(due_ms(&bursts), Some(66 * 4 + 40 + 66));
        assert_eq!(due_ms(&bursts[..4]), Some(33 * 4 + 8), "two bursts may be chance");
        // One frame in time, and the source is steady.
        let mut mixed = bursts.clone();
        mixed.extend([(10, 330, 370), (11, 363, 403)]);
        assert_eq!(due_ms(&mixed), Some(363 + 33 + 8));
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
    fn a_tile_that_would_not_be_cut_in_time_is_not_begun() {
        let mut unknown = Cadence::default();
        unknown.note_cut(5 * MS);
        assert!(unknown.has_time_to_cut(false, 0));
        let mut due_at_160 = cadence(&[(0, 100, 100), (1, 130, 130)]);
        assert!(
            due_at_160.has_time_to_cut(false, 159 * MS)
                && !due_at_160.has_time_to_cut(false, 160 * MS)
        );
        (0..100).for_each(|_| due_at_160.note_cut(5 * MS));
        assert!(
            due_at_160.has_time_to_cut(false, 154 * MS)
                && !due_at_160.has_time_to_cut(false, 156 * MS)
        );
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
        // Times that workers state are bounded.
        due_at_160.note_search(i64::MAX);
        assert!(!is_ahead(&due_at_160, 130));
        (0..60).for_each(|_| due_at_160.note_search(i64::MIN));
        assert!(is_ahead(&due_at_160, 150));
        assert!(!cadence(&[]).has_time_to_cut_ahead(0));
    }

    #[test]
    fn broken_clocks_make_nothing_due() {
        assert_eq!(cadence(&[(0, 100, 104), (1, 100, 134)]).due_ns(), None, "it stands");
        assert_eq!(cadence(&[(0, 130, 104), (1, 100, 134)]).due_ns(), None, "it goes back");
        let mut wild = Cadence::default();
        for (sequence, exposure_ns) in [(0, i64::MIN), (u64::MAX, i64::MAX)] {
            wild.note(&FrameStamp { sequence, exposure_ns, ..FrameStamp::default() }, 5);
        }
        assert_eq!(wild.due_ns(), None);
    }
}
