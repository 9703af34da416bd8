//! Which frame of which epoch a picture is, and what lies between two of them. It has no port and
//! no clock.

use flockeye_config::{Flow, Resolved};
use flockeye_contract::{FrameHeader, FrameStamp, PixelFormat, Projection, Range, Transfer};
use flockeye_convert::projection_of;

/// When a picture was taken, as its source reports.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PictureTime {
    /// Its number since the source was opened, of those that it gave.
    pub sequence: u64,
    /// The number that its frame has: the same, or that of a recorded flight.
    pub number: u64,
    /// Its place in the stream, nanoseconds.
    pub stream_ns: i64,
    /// The middle of its exposure, CLOCK_MONOTONIC, nanoseconds.
    pub exposure_ns: i64,
}

/// What is known of a picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PictureFacts {
    /// When it was taken.
    pub time: PictureTime,
    /// Its columns and rows.
    pub size_px: (u32, u32),
    /// The range of its code values.
    pub range: Range,
    /// Exposure time and readout time of a recorded flight's frame, nanoseconds.
    pub recorded_ns: Option<(u64, u64)>,
}

/// What all frames of a source have in common.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameSettings {
    /// How frames flow.
    pub flow: Flow,
    /// The generation of this stage.
    pub generation: u32,
    /// The camera's curve, and its gamma.
    pub transfer: (Transfer, f32),
    /// The camera's projection.
    pub projection: Projection,
    /// Time between the first and the last row, nanoseconds.
    pub readout_ns: u64,
}

impl FrameSettings {
    /// The settings of a configuration, in generation `generation` of this stage.
    pub fn of(resolved: &Resolved, generation: u32) -> Self {
        Self {
            flow: resolved.pipeline.flow(),
            generation,
            transfer: resolved.transfer,
            projection: projection_of(&resolved.camera),
            readout_ns: (resolved.pipeline.camera.readout_ms * 1e6) as u64,
        }
    }
}

/// What capture keeps between frames.
#[derive(Debug, Clone)]
pub struct Core {
    settings: FrameSettings,
    epoch: u32,
    next_sequence: u64,
    has_ended: bool,
}

impl Core {
    /// A core before the first frame.
    pub fn new(settings: FrameSettings) -> Self {
        Self { settings, epoch: 0, next_sequence: 0, has_ended: false }
    }

    /// The header of a picture that is published at `published_ns`, and how many frames the source
    /// left out before it because a newer one had come. In lossless flow a picture's exposure is
    /// its stream time, so that filters see the recording's clock.
    pub fn on_picture(&mut self, picture: &PictureFacts, published_ns: i64) -> (FrameHeader, u64) {
        let PictureFacts { time, size_px: (width, height), range, recorded_ns } = *picture;
        let FrameSettings { flow, generation, transfer, projection, readout_ns } = self.settings;
        let dropped = time.sequence.saturating_sub(self.next_sequence);
        self.next_sequence = time.sequence.saturating_add(1);
        let exposure_ns = match flow {
            Flow::Latest => time.exposure_ns,
            Flow::Lossless => time.stream_ns,
        };
        let stamp = FrameStamp {
            sequence: time.number,
            exposure_ns,
            stream_ns: time.stream_ns,
            published_ns,
            epoch: self.epoch,
            source_generation: generation,
        };
        let (exposure_time_ns, readout_ns) = recorded_ns.unwrap_or((0, readout_ns));
        let header = FrameHeader {
            stamp,
            exposure_time_ns,
            readout_ns,
            width,
            height,
            stride: width,
            pixel_format: PixelFormat::Gray8.code(),
            transfer: transfer.0.code(),
            gamma: transfer.1,
            range: range.code(),
            projection: projection.code(),
        };
        (header, dropped)
    }

    /// The source counts from 0 again: it loops, or was opened again.
    pub fn begin_epoch(&mut self) {
        self.epoch += 1;
        self.next_sequence = 0;
    }

    /// Which epoch it is.
    pub fn epoch(&self) -> u32 {
        self.epoch
    }

    /// The source has come to its end.
    pub fn end(&mut self) {
        self.has_ended = true;
    }

    /// Whether nothing more is to come.
    pub fn has_ended(&self) -> bool {
        self.has_ended
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn core(flow: Flow, generation: u32) -> Core {
        let (transfer, projection) = ((Transfer::Srgb, 0.0), Projection::Equirectangular);
        Core::new(FrameSettings { flow, generation, transfer, projection, readout_ns: 7 })
    }

    fn picture(sequence: u64) -> PictureFacts {
        let stream_ns = 40 * sequence as i64;
        let exposure_ns = 1000 + stream_ns;
        let time = PictureTime { sequence, number: sequence, stream_ns, exposure_ns };
        PictureFacts { time, size_px: (8, 4), range: Range::Full, recorded_ns: None }
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
            flown.time.number = number;
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
