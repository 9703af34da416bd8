//! What a tape gives: coded pictures, samples, and what is damaged.

use flockeye_contract::{FrameHeader, ImuSample};

/// Which process of the source, and which of its epochs: generation and epoch.
pub(crate) type Epoch = (u32, u32);

/// How pictures are coded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Coding {
    Jpeg,
    H264,
    H265,
}

/// A coded picture.
#[derive(Debug, PartialEq)]
pub(crate) struct CodedPicture {
    pub(crate) epoch: Epoch,
    pub(crate) coding: Coding,
    /// Its place among the pictures of its epoch, nanoseconds: its exposure, or that of a packet in
    /// its stream.
    pub(crate) time_ns: i64,
    /// The frame's header. `None`: it was decoded and not published.
    pub(crate) header: Option<FrameHeader>,
    pub(crate) bytes: Vec<u8>,
}

/// A sample, and which process of the sensor in which epoch it is of.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct TapeSample {
    pub(crate) epoch: Epoch,
    pub(crate) sample: ImuSample,
}

/// What comes next of a recording.
#[derive(Debug, PartialEq)]
pub(crate) enum TapeItem {
    Coded(CodedPicture),
    /// Something that cannot be used; the rest goes on.
    Damaged {
        what: String,
        why: String,
    },
    End,
}
