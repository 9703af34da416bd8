//! When the next frame is due.
//!
//! What is left of a frame's time is for searching partitions. A source that is late, because it
//! decodes or draws on the same processors, would be later still if the search went on until it came.

use std::collections::VecDeque;

use flockeye_contract::FrameStamp;

/// Frames from which it is learnt: about a second.
const FRAMES: usize = 32;

/// The frames of a source that came last.
#[derive(Debug, Clone, Default)]
pub struct Cadence {
    frames: VecDeque<(FrameStamp, i64)>,
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

    /// When the frame after the last one will be here if it is as quick as the quickest lately,
    /// CLOCK_MONOTONIC, nanoseconds; `None` while that is not known.
    pub fn due_ns(&self) -> Option<i64> {
        let ((first, _), (last, _)) = (self.frames.front()?, self.frames.back()?);
        let frames = i64::try_from(last.sequence.checked_sub(first.sequence)?).ok()?;
        let interval_ns = last.exposure_ns.checked_sub(first.exposure_ns)?.checked_div(frames)?;
        let lags = self.frames.iter().map(|(stamp, at_ns)| at_ns.checked_sub(stamp.exposure_ns));
        let lag_ns = lags.collect::<Option<Vec<i64>>>()?.into_iter().min()?;
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
