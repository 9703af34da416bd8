//! Arrival times of coded frames.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex};

use flockeye_runtime::clock::monotonic_ns;
use flockeye_runtime::lock::lock;
use gstreamer as gst;
use gstreamer::prelude::*;

/// Calls `note` with the time stamp of each buffer that goes through a pad.
pub(crate) fn on_each_buffer(
    pad: &gst::Pad,
    note: impl Fn(gst::ClockTime) + Send + Sync + 'static,
) {
    pad.add_probe(gst::PadProbeType::BUFFER, move |_, info| {
        if let Some(pts) = info.buffer().and_then(|buffer| buffer.pts()) {
            note(pts);
        }
        gst::PadProbeReturn::Ok
    });
}

/// Arrival times of the camera's coded frames, by their time stamps.
///
/// Decoding time varies, so the arrival of the data from the camera is used instead. The time stamp
/// is the key, because parsers and decoders preserve it.
#[derive(Debug, Default)]
pub(crate) struct Arrivals(Mutex<VecDeque<(gst::ClockTime, i64)>>);

impl Arrivals {
    /// Number of entries: more than the frames inside a decoder, and few enough for a linear
    /// search.
    const KEPT: usize = 64;

    /// Notes the times at which buffers leave the pipeline's sources.
    pub(crate) fn of(pipeline: &gst::Pipeline) -> Arc<Self> {
        let arrivals = Arc::new(Self::default());
        let mut sources = pipeline.iterate_sources();
        while let Ok(Some(source)) = sources.next() {
            let Some(pad) = source.static_pad("src") else { continue };
            let noted = Arc::clone(&arrivals);
            on_each_buffer(&pad, move |pts| noted.enter(pts, monotonic_ns()));
        }
        arrivals
    }

    fn enter(&self, pts: gst::ClockTime, arrival_ns: i64) {
        let mut entries = lock(&self.0);
        // A frame may have several buffers: its arrival is that of the last.
        entries.retain(|&(known, _)| known != pts);
        if entries.len() >= Self::KEPT {
            entries.pop_front();
        }
        entries.push_back((pts, arrival_ns));
    }

    pub(crate) fn find(&self, pts: gst::ClockTime) -> Option<i64> {
        let entries = lock(&self.0);
        entries.iter().find(|&&(known, _)| known == pts).map(|&(_, arrival_ns)| arrival_ns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arrivals_are_found_by_time_stamp_and_forgotten_in_time() {
        let arrivals = Arrivals::default();
        let pts = gst::ClockTime::from_mseconds;
        for k in 0..100 {
            arrivals.enter(pts(k), k as i64);
        }
        arrivals.enter(pts(98), 1_000);
        assert_eq!(arrivals.find(pts(99)), Some(99));
        assert_eq!(arrivals.find(pts(98)), Some(1_000));
        assert_eq!(arrivals.find(pts(0)), None);
    }
}
