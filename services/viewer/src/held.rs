//! The frame from which the next picture is made.
//!
//! A picture is shown with its detections and tracks. So up to two frames are held, without a copy,
//! until one of them has ended. Frames are held only while a picture is due. Where no frame ends
//! any more (fusion hangs, for example), the picture is shown alone after a timeout.

use std::collections::VecDeque;

use flockeye_contract::FrameStamp;

/// Maximum frames that are held. iceoryx2 lets a reader borrow four ([`flockeye_runtime::memory`]),
/// and one more is borrowed while the newest is taken.
const MOST: usize = 2;
/// Timeout after which a due picture is shown without its detections, nanoseconds.
const PATIENCE_NS: i64 = 400_000_000;

/// The held frames, one of which becomes the next picture.
#[derive(Debug)]
pub(crate) struct Held<F> {
    period_ns: i64,
    /// Frames that were published before this time are not shown.
    due_ns: i64,
    frames: VecDeque<(FrameStamp, F)>,
}

impl<F> Held<F> {
    /// Starts without frames. Pictures are made about `period_ns` nanoseconds apart.
    pub(crate) fn new(period_ns: i64) -> Self {
        Self { period_ns, due_ns: i64::MIN, frames: VecDeque::new() }
    }

    /// Takes a new frame, and drops it at once unless a picture is due. The oldest frame stays,
    /// because it ends first; a newer frame replaces the one behind it.
    pub(crate) fn frame(&mut self, stamp: FrameStamp, frame: F) {
        if stamp.published_ns < self.due_ns {
            return;
        }
        if self.frames.len() == MOST {
            self.frames.pop_back();
        }
        self.frames.push_back((stamp, frame));
    }

    /// The frame that has ended, if it is held: a picture is now made from it. Frames end in order,
    /// so older ones are dropped.
    pub(crate) fn ended(&mut self, stamp: &FrameStamp) -> Option<F> {
        while self.frames.front().is_some_and(|(held, _)| held.order() < stamp.order()) {
            self.frames.pop_front();
        }
        self.frames.front().filter(|(held, _)| held.is_same_frame(stamp))?;
        self.take().map(|(_, frame)| frame)
    }

    /// The oldest frame, if it has not ended within the timeout.
    pub(crate) fn overdue(&mut self, now_ns: i64) -> Option<(FrameStamp, F)> {
        let (oldest, _) = self.frames.front()?;
        (now_ns.saturating_sub(oldest.published_ns) > PATIENCE_NS).then(|| self.take())?
    }

    pub(crate) fn clear(&mut self) {
        self.frames.clear();
    }

    fn take(&mut self) -> Option<(FrameStamp, F)> {
        let taken = self.frames.pop_front()?;
        let (at_ns, half_ns) = (taken.0.published_ns, self.period_ns / 2);
        // The due time follows the clock, so that the mean rate is the requested one. Missed
        // pictures are not made up for.
        let in_step = self.due_ns.saturating_add(self.period_ns);
        self.due_ns = in_step.max(at_ns.saturating_add(half_ns));
        self.frames.retain(|(held, _)| held.published_ns >= self.due_ns);
        Some(taken)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    const MS: i64 = 1_000_000;

    fn stamp(sequence: i64, at_ms: i64) -> FrameStamp {
        let sequence = sequence.unsigned_abs();
        FrameStamp { sequence, published_ns: at_ms * MS, ..FrameStamp::default() }
    }

    /// Pictures in a second of a source that sends a frame each 33 ms, where of `skipped` frames
    /// one never ends.
    fn pictures(rate: i64, latency_ms: i64, skipped: i64) -> i32 {
        let mut held = Held::new(1000 * MS / rate);
        let mut pictures = 0;
        for ms in 0..1000 {
            if ms % 33 == 0 {
                held.frame(stamp(ms / 33, ms), ());
            }
            let ended_ms = ms - latency_ms;
            if ended_ms >= 0 && ended_ms % 33 == 0 && (ended_ms / 33) % skipped != skipped - 1 {
                pictures += i32::from(held.ended(&stamp(ended_ms / 33, 0)).is_some());
            }
            assert!(held.frames.len() <= MOST);
        }
        pictures
    }

    #[test]
    fn the_wanted_rate_is_kept_with_a_few_frames_held() {
        for (rate, latency_ms, least, most) in [
            (15, 20, 14, 16),
            (15, 50, 13, 16),
            (10, 50, 9, 11),
            (30, 50, 26, 31),
            (15, 150, 5, 16),
        ] {
            let made = pictures(rate, latency_ms, i64::MAX);
            assert!((least..=most).contains(&made), "{made} at {rate}/s after {latency_ms} ms");
        }
        assert!(pictures(15, 50, 2) >= 10, "where each second frame never ends");
    }

    #[test]
    fn a_frame_that_never_ends_is_shown_at_last() {
        let mut held = Held::new(66 * MS);
        held.frame(stamp(1, 100), "one");
        held.frame(stamp(2, 133), "two");
        held.frame(stamp(3, 166), "three");
        assert_eq!(held.overdue(400 * MS), None);
        let (of, frame) = held.overdue(510 * MS).unwrap();
        assert_eq!((of.sequence, frame), (1, "one"));
        assert_eq!(held.ended(&stamp(3, 0)), Some("three"));
        held.frame(stamp(4, 170), "four");
        assert!(held.frames.is_empty(), "it comes too soon");
    }
}
