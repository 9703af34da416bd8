//! A frame's luma, in the decoder's own memory.

use std::fmt;
use std::time::Duration;

use flockeye_contract::{FrameHeader, ImuSample, Range};
use gstreamer as gst;
use gstreamer_video as gst_video;
use gstreamer_video::prelude::*;
use gstreamer_video::{VideoColorRange, VideoFormat};

use crate::core::PictureFacts;

/// Raw formats whose first plane is contiguous 8-bit luma.
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

/// A frame's luma plane, read in place. The decoder's buffer is released on drop, so drop it soon.
pub struct SourcePicture {
    // Boxed: GStreamer's structure is large, and events are moved by value.
    frame: Box<gst_video::VideoFrame<gst_video::video_frame::Readable>>,
    stride: usize,
    bytes: usize,
    pub(crate) stamp: PictureStamp,
    pub(crate) recorded: Option<Box<FlightFrame>>,
}

/// Generation of the source's process, and its epoch.
pub(crate) type Epoch = (u32, u32);

/// A sample of a recorded flight, with the epoch of its sensor.
pub(crate) type TapeSample = (Epoch, ImuSample);

/// Data of a recorded flight for a picture.
#[derive(Debug)]
pub(crate) struct FlightFrame {
    /// Header of the frame; its stream time refers to the whole recording.
    pub(crate) header: FrameHeader,
    /// Inertial samples up to this picture, after those of the picture before.
    pub(crate) samples: Vec<TapeSample>,
    /// Sequence number among the available pictures.
    pub(crate) sequence: u64,
    pub(crate) exposure_ns: i64,
}

/// Number and times of a picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct PictureStamp {
    pub(crate) sequence: u64,
    pub(crate) stream_time: Duration,
    pub(crate) exposure_ns: i64,
    pub(crate) pts: Option<gst::ClockTime>,
}

impl SourcePicture {
    /// Maps a decoded buffer. The error is the reason of the failure.
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
    /// apart. It ends with the last pixel of the last row.
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

    /// Range of code values as the stream declares it. Default of GStreamer: video is limited, gray
    /// images are full.
    pub fn range(&self) -> Range {
        let recorded = self.recorded.as_ref().map(|recorded| recorded.header.range);
        let recorded = recorded.and_then(|code| Range::try_from(code).ok());
        recorded.unwrap_or_else(|| range_of(self.frame.info()))
    }

    /// Name of the decoder's raw format, such as `I420`.
    pub fn format(&self) -> &str {
        self.frame.info().name()
    }

    /// Sequence number, from 0 in each round (see [`crate::Event::Looped`] and
    /// [`crate::Event::Lost`]). Dropped frames leave gaps.
    pub fn sequence(&self) -> u64 {
        self.stamp.sequence
    }

    /// Stream time since the first frame.
    pub fn stream_time(&self) -> Duration {
        self.stamp.stream_time
    }

    /// Exposure time, nanoseconds. On CLOCK_MONOTONIC for a camera (arrival minus latency) and for
    /// a recording in real time; stream time in lossless flow.
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
