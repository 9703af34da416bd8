//! Sequence numbers, epochs and headers of pictures, and dropped frames. It has no port and no
//! clock.

use flockeye_config::{Flow, Resolved};
use flockeye_contract::{FrameHeader, FrameStamp, Range};
use flockeye_convert::frame_header;

/// Facts about a picture for its frame header.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PictureFacts {
    /// Sequence number since the source was opened.
    pub sequence: u64,
    /// Frame number: equal to the sequence number, or from a recorded flight.
    pub number: u64,
    /// Stream time, nanoseconds.
    pub stream_ns: i64,
    /// Middle of the exposure, CLOCK_MONOTONIC, nanoseconds.
    pub exposure_ns: i64,
    /// Columns and rows.
    pub size_px: (u32, u32),
    /// Range of the code values.
    pub range: Range,
    /// Exposure time and readout time of a recorded flight's frame, nanoseconds.
    pub recorded_ns: Option<(u64, u64)>,
}

/// State of capture between frames.
#[derive(Debug, Clone)]
pub struct Core {
    flow: Flow,
    /// Header fields that are equal in all frames of this epoch.
    common: FrameHeader,
    next_sequence: u64,
    has_ended: bool,
}

impl Core {
    /// A core before the first frame, in generation `generation` of this stage.
    pub fn of(resolved: &Resolved, generation: u32) -> Self {
        let pipeline = &resolved.pipeline;
        let readout_ms = pipeline.camera.readout_ms;
        let common = frame_header(&resolved.camera, resolved.transfer, readout_ms);
        Self::new(pipeline.flow(), common, generation)
    }

    fn new(flow: Flow, common: FrameHeader, generation: u32) -> Self {
        let stamp = FrameStamp { source_generation: generation, ..FrameStamp::default() };
        let common = FrameHeader { stamp, ..common };
        Self { flow, common, next_sequence: 0, has_ended: false }
    }

    /// The header of a picture published at `published_ns`, and the number of frames dropped before
    /// it. In lossless flow the exposure is stream time, so that filters use the recording's clock.
    pub fn on_picture(&mut self, picture: &PictureFacts, published_ns: i64) -> (FrameHeader, u64) {
        let PictureFacts { sequence, number, stream_ns, size_px: (width, height), .. } = *picture;
        let dropped = sequence.saturating_sub(self.next_sequence);
        self.next_sequence = sequence.saturating_add(1);
        let exposure_ns = match self.flow {
            Flow::Latest => picture.exposure_ns,
            Flow::Lossless => stream_ns,
        };
        let stamp = FrameStamp {
            sequence: number,
            exposure_ns,
            stream_ns,
            published_ns,
            ..self.common.stamp
        };
        let (exposure_time_ns, readout_ns) =
            picture.recorded_ns.unwrap_or((0, self.common.readout_ns));
        let header = FrameHeader {
            stamp,
            exposure_time_ns,
            readout_ns,
            width,
            height,
            stride: width,
            range: picture.range.code(),
            ..self.common
        };
        (header, dropped)
    }

    /// Begins an epoch: the source restarts at 0, because it loops or was opened again.
    pub(crate) fn begin_epoch(&mut self) {
        self.common.stamp.epoch += 1;
        self.next_sequence = 0;
    }

    /// Current epoch.
    pub(crate) fn epoch(&self) -> u32 {
        self.common.stamp.epoch
    }

    /// Notes the end of the source.
    pub(crate) fn end(&mut self) {
        self.has_ended = true;
    }

    /// Whether the source has ended.
    pub(crate) fn has_ended(&self) -> bool {
        self.has_ended
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn core(flow: Flow, generation: u32) -> Core {
        Core::new(flow, FrameHeader { readout_ns: 7, ..FrameHeader::default() }, generation)
    }

    fn picture(sequence: u64) -> PictureFacts {
        let stream_ns = 40 * sequence as i64;
        let exposure_ns = 1000 + stream_ns;
        PictureFacts {
            sequence,
            number: sequence,
            stream_ns,
            exposure_ns,
            size_px: (8, 4),
            range: Range::Full,
            recorded_ns: None,
        }
    }

    #[test]
    fn frames_left_out_by_the_source_are_counted_once() {
        let mut core = core(Flow::Latest, 3);
        let dropped: Vec<u64> =
            [0, 1, 4, 5].map(|sequence| core.on_picture(&picture(sequence), 0).1).into();
        assert_eq!(dropped, [0, 0, 2, 0]);
    }

    #[test]
    fn frames_of_a_recorded_flight_keep_their_numbers_and_nothing_is_left_out() {
        let mut core = core(Flow::Latest, 0);
        for (sequence, number) in [(0, 30), (1, 60), (2, 90)] {
            let mut flown = picture(sequence);
            flown.number = number;
            flown.recorded_ns = Some((5, 9));
            let (header, dropped) = core.on_picture(&flown, 0);
            assert_eq!((header.stamp.sequence, dropped), (number, 0));
            assert_eq!((header.exposure_time_ns, header.readout_ns), (5, 9));
        }
    }

    #[test]
    fn a_new_epoch_counts_from_zero_and_drops_nothing() {
        let mut core = core(Flow::Latest, 3);
        core.on_picture(&picture(7), 0);
        core.begin_epoch();
        let (FrameHeader { stamp, readout_ns, .. }, dropped) = core.on_picture(&picture(0), 2000);
        assert_eq!(readout_ns, 7, "the configured one");
        assert_eq!((stamp.order(), dropped), ((3, 1, 0), 0));
        assert_eq!((stamp.exposure_ns, stamp.published_ns), (1000, 2000));
    }

    #[test]
    fn lossless_exposures_are_stream_times() {
        let mut core = core(Flow::Lossless, 0);
        let (FrameHeader { stamp, .. }, _) = core.on_picture(&picture(2), 9);
        assert_eq!((stamp.exposure_ns, stamp.stream_ns), (80, 80));
        assert!(!core.has_ended());
        core.end();
        assert!(core.has_ended());
    }
}
