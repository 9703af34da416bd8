//! Detection of decoders that hold frames back, or that are too slow.
//!
//! Coded frames are counted into the decoder, and pictures out of it, by their time stamps. A
//! decoder without delay has no frame inside when a picture comes out. A decoder with frame threads
//! or reordering always has some inside. A growing wait before the decoder shows that it is too
//! slow.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use flockeye_runtime::clock::monotonic_ns;
use flockeye_runtime::lock::lock;
use gstreamer as gst;
use gstreamer::prelude::*;

use crate::arrivals::{Arrivals, on_each_buffer};
use crate::decoder;

/// Length of a window in pictures: one second at 30 pictures/s. The minimum of frames inside over a
/// window is held back.
const WINDOW: u32 = 30;
/// Minimum number of pictures in a window with a known time stamp: some decoders change time
/// stamps.
const MATCHED: u32 = 24;
/// Implausible number of frames inside: the pictures then have other time stamps than the frames.
const MOST_INSIDE: usize = 64;
/// Increase of the wait before the decoder, or delay of a paced recording's frames behind it, from
/// which the decoder counts as too slow, nanoseconds.
pub(crate) const BEHIND_NS: i64 = 100_000_000;

/// A problem of a decoder.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum DecoderFault {
    /// The decoder holds frames back.
    Holds {
        /// Minimum number of held frames.
        frames: usize,
        /// Resulting latency, by the rate of the pictures.
        delay: Duration,
        /// Whether decoding order and presentation order differ.
        reordered: bool,
    },
    /// The decoder is too slow; frames wait this long before it.
    IsBehind(Duration),
}

/// Counters of one pipeline's decoders, one per decoder: a description may have several in series.
#[derive(Debug)]
pub(crate) struct DecoderWatch {
    counts: Mutex<Vec<Arc<Mutex<FrameCount>>>>,
    arrivals: Arc<Arrivals>,
}

impl DecoderWatch {
    pub(crate) fn new(arrivals: Arc<Arrivals>) -> Arc<Self> {
        Arc::new(Self { counts: Mutex::default(), arrivals })
    }

    /// Counts the buffers through an element, if it is a decoder.
    pub(crate) fn attach(self: &Arc<Self>, element: &gst::Element) {
        let pads = (element.static_pad("sink"), element.static_pad("src"));
        let (true, (Some(sink), Some(src))) = (decoder::is_decoder(element), pads) else { return };
        let count = Arc::new(Mutex::new(FrameCount::default()));
        lock(&self.counts).push(Arc::clone(&count));
        let (watch, entering) = (Arc::clone(self), Arc::clone(&count));
        on_each_buffer(&sink, move |pts| {
            let arrival_ns = watch.arrivals.find(pts);
            let waited_ns = arrival_ns.map(|arrival_ns| monotonic_ns() - arrival_ns);
            lock(&entering).enter(pts, waited_ns);
        });
        on_each_buffer(&src, move |pts| lock(&count).leave(pts, monotonic_ns()));
    }

    /// Takes the next detected problem.
    pub(crate) fn take(&self) -> Option<DecoderFault> {
        lock(&self.counts).iter().find_map(|count| lock(count).noticed.pop_front())
    }
}

#[derive(Debug, Default)]
struct FrameCount {
    /// Time stamps of the frames inside, in decoding order.
    inside: VecDeque<gst::ClockTime>,
    newest: Option<gst::ClockTime>,
    reordered: bool,
    window: Option<CountWindow>,
    windows: u32,
    /// Reference for the wait, from the first judged window, nanoseconds.
    usual_wait_ns: Option<i64>,
    has_said_held: bool,
    has_said_behind: bool,
    noticed: VecDeque<DecoderFault>,
}

#[derive(Debug)]
struct CountWindow {
    begun_ns: i64,
    pictures: u32,
    matched: u32,
    least_held: usize,
    least_wait_ns: Option<i64>,
}

impl FrameCount {
    /// Notes a coded frame at the decoder's input, `waited_ns` after its arrival, if known.
    fn enter(&mut self, pts: gst::ClockTime, waited_ns: Option<i64>) {
        self.reordered |= self.newest.is_some_and(|newest| pts < newest);
        self.newest = Some(pts);
        if self.inside.back() != Some(&pts) {
            self.inside.push_back(pts);
        }
        if self.inside.len() > MOST_INSIDE {
            self.inside.pop_front();
        }
        if let (Some(window), Some(waited_ns)) = (&mut self.window, waited_ns) {
            let least = window.least_wait_ns.unwrap_or(i64::MAX);
            window.least_wait_ns = Some(least.min(waited_ns));
        }
    }

    fn leave(&mut self, pts: gst::ClockTime, now_ns: i64) {
        let is_known = self.inside.contains(&pts);
        // Pictures come out in presentation order: frames before this one were lost.
        self.inside.retain(|inside| *inside > pts);
        let held = self.inside.len();
        let Some(window) = &mut self.window else {
            self.window = Some(CountWindow::begin(now_ns));
            return;
        };
        window.pictures += 1;
        window.matched += u32::from(is_known);
        window.least_held = window.least_held.min(held);
        if window.pictures == WINDOW
            && let Some(window) = self.window.replace(CountWindow::begin(now_ns))
        {
            self.judge(&window, now_ns);
        }
    }

    fn judge(&mut self, window: &CountWindow, now_ns: i64) {
        self.windows += 1;
        // The first window, during the start, is ignored.
        if self.windows == 1 {
            return;
        }
        let frames = window.least_held;
        let is_counted = window.matched >= MATCHED && frames < MOST_INSIDE / 2;
        if is_counted && frames > 0 && !self.has_said_held {
            self.has_said_held = true;
            let each_ns = (now_ns - window.begun_ns).max(0).unsigned_abs() / u64::from(WINDOW);
            let delay = Duration::from_nanos(each_ns * frames as u64);
            let reordered = self.reordered;
            self.noticed.push_back(DecoderFault::Holds { frames, delay, reordered });
        }
        let Some(wait_ns) = window.least_wait_ns else { return };
        let usual_ns = *self.usual_wait_ns.get_or_insert(wait_ns);
        if wait_ns - usual_ns > BEHIND_NS && !self.has_said_behind {
            self.has_said_behind = true;
            let behind = Duration::from_nanos((wait_ns - usual_ns).unsigned_abs());
            self.noticed.push_back(DecoderFault::IsBehind(behind));
        }
    }
}

impl CountWindow {
    fn begin(begun_ns: i64) -> Self {
        Self { begun_ns, pictures: 0, matched: 0, least_held: usize::MAX, least_wait_ns: None }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    const STEP_NS: i64 = 33_333_333;

    fn pts(frame: i64) -> gst::ClockTime {
        gst::ClockTime::from_nseconds((frame * STEP_NS).unsigned_abs())
    }

    /// A decoder that gives each frame when `after` later ones are in.
    fn delayed(after: i64) -> FrameCount {
        let mut count = FrameCount::default();
        for frame in 0..100 {
            count.enter(pts(frame), Some(1_000_000));
            if frame >= after {
                count.leave(pts(frame - after), frame * STEP_NS);
            }
        }
        // At the end it gives what it has.
        (100 - after..100).for_each(|frame| count.leave(pts(frame), 100 * STEP_NS));
        count
    }

    #[test]
    fn what_a_decoder_holds_back_is_said_once() {
        assert!(delayed(0).noticed.is_empty());
        let noticed = delayed(3).noticed;
        let Some(DecoderFault::Holds { frames: 3, delay, reordered: false }) = noticed.front()
        else {
            panic!("{noticed:?}");
        };
        assert_eq!((noticed.len(), delay.as_millis()), (1, 99));
    }

    #[test]
    fn frames_that_rest_on_later_ones_are_noticed_as_such() {
        let mut count = FrameCount::default();
        let mut out = 0;
        // Each third frame comes before the two that are shown before it.
        for group in 0..40 {
            for frame in [3 * group + 2, 3 * group, 3 * group + 1] {
                count.enter(pts(frame), None);
                if frame != 3 * group + 2 {
                    count.leave(pts(out), out * STEP_NS);
                    out += 1;
                }
            }
            count.leave(pts(out), out * STEP_NS);
            out += 1;
        }
        // The last of each group is out as soon as the group is in; the first ones have the last
        // inside.
        assert!(count.reordered && count.noticed.is_empty(), "{:?}", count.noticed);
        assert!(!delayed(3).reordered);
    }

    #[test]
    fn frames_that_wait_for_an_order_that_is_never_used_up_are_noticed() {
        let mut count = FrameCount::default();
        // Coded in groups of three, the last first; the decoder gives nothing before three are
        // inside.
        let coded = (0..40).flat_map(|group| [3 * group + 2, 3 * group, 3 * group + 1]);
        for (out, frame) in coded.enumerate() {
            count.enter(pts(frame), None);
            if let Some(out) = out.checked_sub(3) {
                count.leave(pts(out as i64), out as i64 * STEP_NS);
            }
        }
        let noticed: Vec<DecoderFault> = count.noticed.into();
        let [DecoderFault::Holds { frames, reordered: true, .. }] = noticed[..] else {
            panic!("{noticed:?}");
        };
        assert!((2..=3).contains(&frames), "{frames}");
    }

    #[test]
    fn frames_that_are_lost_or_stamped_anew_are_not_held() {
        let mut count = FrameCount::default();
        for frame in 0..200 {
            count.enter(pts(frame), None);
            // Every fifth frame is damaged and gives no picture. The others give one at once.
            if frame % 5 != 0 {
                count.leave(pts(frame), frame * STEP_NS);
            }
        }
        let mut anew = FrameCount::default();
        for frame in 0..200 {
            anew.enter(pts(frame), None);
            anew.leave(pts(frame + 1_000_000), frame * STEP_NS);
        }
        assert!(anew.noticed.is_empty(), "{:?}", anew.noticed);
        assert!(count.noticed.is_empty(), "{:?}", count.noticed);
    }

    #[test]
    fn a_decoder_that_does_not_keep_up_is_noticed() {
        let waiting = |of: fn(i64) -> i64| {
            let mut count = FrameCount::default();
            for frame in 0..300 {
                count.enter(pts(frame), Some(of(frame)));
                count.leave(pts(frame), frame * STEP_NS);
            }
            count.noticed
        };
        // An encoder in between may take its time, as long as it is always the same.
        assert!(waiting(|_| 500_000_000).is_empty());
        let noticed = waiting(|frame| 2_000_000 * frame);
        let Some(DecoderFault::IsBehind(by)) = noticed.front() else { panic!("{noticed:?}") };
        assert!(noticed.len() == 1 && by.as_millis() > 100, "{noticed:?}");
    }
}
