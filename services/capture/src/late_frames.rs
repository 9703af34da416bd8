//! Coded frames of a paced recording that would be decoded too late. They are dropped before the
//! decoder.
//!
//! A decoder that is slower than the recording makes each pose older. Frames to which no other
//! frame refers can be left out, and every second frame of many encoders is one (B-frame). So the
//! decoder keeps up, and the other stages have its processor time.

use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};

use flockeye_runtime::clock::monotonic_ns;
use flockeye_runtime::lock::lock;
use flockeye_runtime::logs::Throttle;
use gstreamer as gst;
use gstreamer::prelude::*;
use gstreamer_app as gst_app;

use crate::holding::BEHIND_NS;
use crate::packet_tap::segment_of;
use crate::pipeline::due_ns;

/// Least number of frames between two that are dropped: three quarters of all are decoded.
const KEPT_FRAMES: u64 = 3;

/// Judge of coded frames by the due times of one sink.
#[derive(Debug)]
pub(crate) struct LateFrames {
    sink: gst::glib::WeakRef<gst_app::AppSink>,
    is_behind: AtomicBool,
    dropped: Mutex<Dropped>,
}

#[derive(Debug, Default)]
struct Dropped {
    /// Time stamps of the dropped frames that no decoded frame has followed yet.
    pending: Vec<gst::ClockTime>,
    /// Coded frames since the last dropped one.
    kept: u64,
    warnings: Throttle,
}

impl LateFrames {
    pub(crate) fn new(sink: &gst_app::AppSink) -> Self {
        let (is_behind, dropped) = (AtomicBool::new(false), Mutex::default());
        Self { sink: sink.downgrade(), is_behind, dropped }
    }

    /// Notes a decoded frame that leaves the decoder through `pad`. A decoder that keeps up works
    /// some frames ahead.
    pub(crate) fn note_decoded(&self, pad: &gst::Pad, buffer: &gst::BufferRef) {
        let is_behind = self.lead_ns(pad, buffer).is_some_and(|lead_ns| lead_ns < -BEHIND_NS);
        self.is_behind.store(is_behind, Ordering::Relaxed);
    }

    /// Whether the next coded frame should be left out, because the decoder does not keep up.
    /// After a dropped frame, [`KEPT_FRAMES`] are decoded in any case. Call it once for each frame.
    pub(crate) fn must_drop(&self) -> bool {
        let mut dropped = lock(&self.dropped);
        dropped.kept += 1;
        self.is_behind.load(Ordering::Relaxed) && dropped.kept > KEPT_FRAMES
    }

    /// Time until a frame is due, nanoseconds; `None` where frames have no due time.
    fn lead_ns(&self, pad: &gst::Pad, buffer: &gst::BufferRef) -> Option<i64> {
        let sink = self.sink.upgrade()?;
        if !sink.is_sync() || sink.current_state() != gst::State::Playing {
            return None;
        }
        let running = segment_of(pad)?.to_running_time(buffer.pts()?)?;
        Some(due_ns(&sink, running)? + sink.ts_offset() - monotonic_ns())
    }

    /// Records that a frame was dropped.
    pub(crate) fn note(&self, pts: Option<gst::ClockTime>) {
        let mut dropped = lock(&self.dropped);
        dropped.pending.extend(pts);
        dropped.kept = 0;
        if let Some(before) = dropped.warnings.admit() {
            tracing::warn!(
                left_out = before + 1,
                "frames are left out, because decoding is slower than the recording. Cure: a \
                 hardware decoder, smaller frames, or a lossless profile"
            );
        }
    }

    /// Number of the dropped frames before a decoded one, each counted once.
    pub(crate) fn take_before(&self, pts: Option<gst::ClockTime>) -> u64 {
        let mut dropped = lock(&self.dropped);
        let before = dropped.pending.len();
        dropped.pending.retain(|dropped| pts.is_none_or(|pts| *dropped > pts));
        (before - dropped.pending.len()) as u64
    }
}
