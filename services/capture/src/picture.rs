//! A frame's luma, in the decoder's own memory.

use std::fmt;
use std::time::Duration;

use flockeye_contract::{FrameHeader, ImuSample, Range};
use gstreamer as gst;
use gstreamer_video as gst_video;
use gstreamer_video::prelude::*;
use gstreamer_video::{VideoColorRange, VideoFormat};

use crate::core::PictureFacts;

/// The raw formats whose first plane is 8-bit luma with nothing in between.
pub(crate) const LUMA_FIRST: &[VideoFormat] = &[
    VideoFormat::Gray8,
    VideoFormat::I420,
    VideoFormat::Nv12,
    VideoFormat::Yv12,
    VideoFormat::Nv21,
    VideoFormat::Y42b,
    VideoFormat::Y444,
    VideoFormat::Y41b,
    VideoFormat::Nv16,
    VideoFormat::Nv61,
    VideoFormat::Nv24,
    VideoFormat::Yuv9,
    VideoFormat::Yvu9,
    VideoFormat::A420,
];

/// A frame's luma plane, read in place: the decoder gets its buffer back when this is dropped, so
/// drop it soon.
pub struct SourcePicture {
    // Boxed: GStreamer's structure is large, and events are handed round by value.
    frame: Box<gst_video::VideoFrame<gst_video::video_frame::Readable>>,
    stride: usize,
    bytes: usize,
    pub(crate) stamp: PictureStamp,
    pub(crate) recorded: Option<Box<FlightFrame>>,
}

/// Which process of the source, and which of its epochs: generation and epoch.
pub(crate) type Epoch = (u32, u32);

/// A sample, and which process of the sensor in which epoch it is of.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct TapeSample {
    pub(crate) epoch: Epoch,
    pub(crate) sample: ImuSample,
}

/// What a recording of a flight has of a picture.
#[derive(Debug)]
pub(crate) struct FlightFrame {
    /// Its frame, with its stream time in the time of the recording.
    pub(crate) header: FrameHeader,
    /// The samples of the inertial sensor that had come when it was there, and not with the one
    /// before.
    pub(crate) samples: Vec<TapeSample>,
    /// Its number among the pictures that were there to be handed out.
    pub(crate) sequence: u64,
    pub(crate) exposure_ns: i64,
}

/// Which frame it is, and when its light was caught.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct PictureStamp {
    pub(crate) sequence: u64,
    pub(crate) stream_time: Duration,
    pub(crate) exposure_ns: i64,
    pub(crate) pts: Option<gst::ClockTime>,
}

impl SourcePicture {
    /// Maps a decoded buffer. The error names what is wrong with it.
    pub(crate) fn map(
        buffer: gst::Buffer,
        info: &gst_video::VideoInfo,
        stamp: PictureStamp,
    ) -> Result<Self, String> {
        if !LUMA_FIRST.contains(&info.format()) {
            return Err(format!("its format {} has no luma plane", info.name()));
        }
        let frame = gst_video::VideoFrame::from_buffer_readable(buffer, info)
            .map_err(|_| "its memory cannot be mapped".to_owned())?;
        let stride = usize::try_from(frame.plane_stride()[0])
            .map_err(|_| "its rows run backwards".to_owned())?;
        let (width, height) = (frame.width() as usize, frame.height() as usize);
        let bytes = stride * height.saturating_sub(1) + width;
        let found = frame.plane_data(0).map_or(0, <[u8]>::len);
        if stride < width || found < bytes {
            return Err(format!(
                "{found} bytes with a stride of {stride} do not hold {width}x{height}"
            ));
        }
        Ok(Self { frame: Box::new(frame), stride, bytes, stamp, recorded: None })
    }

    /// The luma plane: [`Self::height`] rows of [`Self::width`] bytes, [`Self::stride`] bytes
    /// apart. It ends with the last row's last pixel.
    pub fn luma(&self) -> &[u8] {
        self.frame.plane_data(0).map_or(&[], |plane| &plane[..self.bytes])
    }

    /// Row `y` of the luma plane, from the top.
    ///
    /// # Panics
    /// If `y` is not below [`Self::height`], as a slice would.
    pub fn row(&self, y: u32) -> &[u8] {
        let start = y as usize * self.stride;
        &self.luma()[start..start + self.width() as usize]
    }

    /// The facts for a frame's header.
    pub fn facts(&self) -> PictureFacts {
        let facts = PictureFacts {
            sequence: self.sequence(),
            number: self.sequence(),
            stream_ns: i64::try_from(self.stream_time().as_nanos()).unwrap_or(i64::MAX),
            exposure_ns: self.exposure_monotonic_ns(),
            size_px: (self.width(), self.height()),
            range: self.range(),
            recorded_ns: None,
        };
        let Some(FlightFrame { header, sequence, exposure_ns, .. }) = self.recorded.as_deref()
        else {
            return facts;
        };
        PictureFacts {
            sequence: *sequence,
            number: header.stamp.sequence,
            stream_ns: header.stamp.stream_ns,
            exposure_ns: *exposure_ns,
            recorded_ns: Some((header.exposure_time_ns, header.readout_ns)),
            ..facts
        }
    }

    /// Pixels in a row.
    pub fn width(&self) -> u32 {
        self.frame.width()
    }

    /// Rows.
    pub fn height(&self) -> u32 {
        self.frame.height()
    }

    /// Bytes from one row to the next.
    pub fn stride(&self) -> usize {
        self.stride
    }

    /// Which code values stand for black and white, as the stream declares. Where it does not
    /// declare that, GStreamer's defaults count: video is limited, gray images are full.
    pub fn range(&self) -> Range {
        let recorded = self.recorded.as_ref().map(|recorded| recorded.header.range);
        let recorded = recorded.and_then(|code| Range::try_from(code).ok());
        recorded.unwrap_or_else(|| range_of(self.frame.info()))
    }

    /// The name of the raw format the decoder gave, such as `I420`.
    pub fn format(&self) -> &str {
        self.frame.info().name()
    }

    /// Frames of the source, from 0 in each round (see [`crate::Event::Looped`] and
    /// [`crate::Event::Lost`]). It jumps where frames were left out.
    pub fn sequence(&self) -> u64 {
        self.stamp.sequence
    }

    /// Time in the stream from its first frame.
    pub fn stream_time(&self) -> Duration {
        self.stamp.stream_time
    }

    /// When the light was caught, nanoseconds: on CLOCK_MONOTONIC for a camera (its arrival less
    /// the latency) and for a recording in real time; the stream's own time in lossless flow.
    pub fn exposure_monotonic_ns(&self) -> i64 {
        self.stamp.exposure_ns
    }
}

impl fmt::Debug for SourcePicture {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("SourcePicture")
            .field("stamp", &self.stamp)
            .field("width", &self.width())
            .field("height", &self.height())
            .field("stride", &self.stride)
            .field("format", &self.format())
            .finish()
    }
}

pub(crate) fn range_of(info: &gst_video::VideoInfo) -> Range {
    match info.colorimetry().range() {
        VideoColorRange::Range0_255 => Range::Full,
        VideoColorRange::Range16_235 => Range::Limited,
        _ if info.is_gray() => Range::Full,
        _ => Range::Limited,
    }
}
