//! `frame`: image of the whole sphere from a source.

use bytemuck::{Pod, Zeroable};
use flockeye_contract_derive::Described;
use iceoryx2::prelude::ZeroCopySend;

use crate::{ContractError, PixelFormat, Projection, Range, Transfer};

/// Identity of a frame, and the time of its exposure.
///
/// It begins every header that follows from a frame, so that each output can be traced to its
/// exposure.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable, ZeroCopySend, Described)]
#[type_name("flockeye/FrameStamp")]
#[repr(C)]
pub struct FrameStamp {
    /// Frames of the source, counted from 0 in each epoch.
    pub sequence: u64,
    /// Middle of the exposure, CLOCK_MONOTONIC, nanoseconds. In a lossless run, which is not in
    /// real time, it equals `stream_ns`.
    pub exposure_ns: i64,
    /// Middle of the exposure in the recording's own time, nanoseconds from its start.
    pub stream_ns: i64,
    /// Time of publication by the source, CLOCK_MONOTONIC, nanoseconds. A latency field.
    pub published_ns: i64,
    /// Rises each time the source restarts or loops.
    pub epoch: u32,
    /// Rises each time the source's process is replaced.
    pub source_generation: u32,
}

/// Order of a frame among all frames: generation of the source, epoch, sequence.
pub type FrameOrder = (u32, u32, u64);

impl FrameStamp {
    /// The key that orders frames: a later epoch, then a later sequence number.
    pub fn order(&self) -> FrameOrder {
        (self.source_generation, self.epoch, self.sequence)
    }

    /// Whether both stamps belong to the same frame.
    pub fn is_same_frame(&self, other: &Self) -> bool {
        self.order() == other.order()
    }

    /// The middle of the exposure, seconds.
    pub fn exposure_s(&self) -> f64 {
        self.exposure_ns as f64 * 1e-9
    }

    /// Average time between frames since `earlier`, nanoseconds of the exposures. `None` across
    /// epochs, and where the exposures do not rise.
    pub fn interval_ns(&self, earlier: &Self) -> Option<i64> {
        let frames = i64::try_from(self.sequence.checked_sub(earlier.sequence)?).ok()?;
        let elapsed_ns = self.exposure_ns.checked_sub(earlier.exposure_ns)?;
        let interval_ns = elapsed_ns.checked_div(frames)?;
        let is_same = self.order().0 == earlier.order().0 && self.epoch == earlier.epoch;
        (is_same && interval_ns > 0).then_some(interval_ns)
    }

    /// Number of frames of the same epoch between `earlier` and this one; 0 across epochs.
    pub fn skipped_since(&self, earlier: &Self) -> u64 {
        let is_same =
            (self.source_generation, self.epoch) == (earlier.source_generation, earlier.epoch);
        let next = earlier.sequence.saturating_add(1);
        if is_same { self.sequence.saturating_sub(next) } else { 0 }
    }

    /// Whether a message of this frame is out of date, given one of `newest`. Fusion may publish a
    /// track of one frame after a track of the next. A reader that keeps only the latest must not
    /// go back. A frame of another epoch, or behind by more than [`LATEST_BY_FRAMES`], is not late:
    /// its source has restarted.
    pub fn is_late_beside(&self, newest: &Self) -> bool {
        (self.source_generation, self.epoch) == (newest.source_generation, newest.epoch)
            && (1..=LATEST_BY_FRAMES).contains(&newest.sequence.wrapping_sub(self.sequence))
    }
}

/// See [`FrameStamp::is_late_beside`].
pub(crate) const LATEST_BY_FRAMES: u64 = 64;

/// Header of a frame. Payload: the luma plane, `stride * height` bytes, then chroma for `nv12`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable, ZeroCopySend, Described)]
#[type_name("flockeye/FrameHeader")]
#[repr(C)]
pub struct FrameHeader {
    /// Identity of this frame.
    pub stamp: FrameStamp,
    /// Length of the exposure, nanoseconds; 0 where the source does not provide it.
    pub exposure_time_ns: u64,
    /// Time between the first and the last row's exposure, nanoseconds; 0 for a global shutter.
    pub readout_ns: u64,
    /// Pixels in a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Bytes from one row to the next.
    pub stride: u32,
    /// A [`PixelFormat`].
    pub pixel_format: u32,
    /// A [`Transfer`].
    pub transfer: u32,
    /// The exponent of [`Transfer::Gamma`]; 0 otherwise.
    pub gamma: f32,
    /// A [`Range`].
    pub range: u32,
    /// A [`Projection`].
    pub projection: u32,
}

/// Maximum width and height of a frame, pixels; larger ones are refused.
pub(crate) const MAX_SIDE_PX: u32 = 16_384;

impl FrameHeader {
    /// Bytes of such a frame's payload.
    pub fn payload_bytes(&self) -> Result<usize, ContractError> {
        let luma = self.stride as usize * self.height as usize;
        Ok(match PixelFormat::try_from(self.pixel_format)? {
            PixelFormat::Gray8 => luma,
            PixelFormat::Nv12 => luma + self.stride as usize * self.height.div_ceil(2) as usize,
        })
    }

    /// Refuses a header that does not describe `payload_bytes` bytes of pixels.
    ///
    /// After the check, the luma plane has `height` rows of `width` bytes, `stride` apart, within
    /// the payload.
    pub fn check(&self, payload_bytes: usize) -> Result<(), ContractError> {
        check_image(self.width, self.height, self.stride)?;
        Projection::try_from(self.projection)?;
        check_curve(self.transfer, self.gamma, self.range)?;
        let needed = self.payload_bytes()?;
        if needed > payload_bytes {
            return Err(ContractError::PayloadTooShort { needed, found: payload_bytes });
        }
        Ok(())
    }
}

/// Refuses an image of invalid size or with overlapping rows.
pub(crate) fn check_image(width: u32, height: u32, stride: u32) -> Result<(), ContractError> {
    if width == 0 || height == 0 || width > MAX_SIDE_PX || height > MAX_SIDE_PX {
        return Err(ContractError::Size { width, height, max: MAX_SIDE_PX });
    }
    if stride < width || stride > 4 * MAX_SIDE_PX {
        return Err(ContractError::Stride { stride, width });
    }
    Ok(())
}

/// Refuses unknown curves and an invalid gamma.
pub(crate) fn check_curve(transfer: u32, gamma: f32, range: u32) -> Result<(), ContractError> {
    Range::try_from(range)?;
    if Transfer::try_from(transfer)? == Transfer::Gamma && !(0.1..=10.0).contains(&gamma) {
        return Err(ContractError::Gamma { gamma });
    }
    Ok(())
}
