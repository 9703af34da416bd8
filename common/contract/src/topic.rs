//! The topics of the dataflow, and the check each message has to pass.

use std::fmt::Debug;

use bytemuck::Pod;
use iceoryx2::prelude::ZeroCopySend;

use crate::{
    BodyTruth, DetectedMarker, DetectionHeader, FrameEnd, FrameHeader, Health, PlanHeader,
    PlannedView, Track, TrackHeader, TruthHeader, UnknownCode, ViewHeader,
};

/// Version of everything in this crate. A stage of another version is refused.
pub const CONTRACT_VERSION: &str = "3";

/// The iceoryx2 service attribute that carries [`CONTRACT_VERSION`].
pub const VERSION_ATTRIBUTE: &str = "flockeye.contract";

/// Why a message was refused.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum ContractError {
    /// An enumeration's code is unknown.
    #[error(transparent)]
    Code(#[from] UnknownCode),
    /// The header announces more bytes than were sent.
    #[error("the header announces {needed} bytes of payload, {found} are there")]
    PayloadTooShort {
        /// What the header announces.
        needed: usize,
        /// What came.
        found: usize,
    },
    /// An image of no, or of absurd, size.
    #[error("an image of {width}x{height} pixels (1 to {max} are allowed)")]
    Size {
        /// Pixels in a row.
        width: u32,
        /// Rows.
        height: u32,
        /// The most allowed.
        max: u32,
    },
    /// Rows that overlap, or are absurdly far apart.
    #[error("rows of {width} pixels that are {stride} bytes apart")]
    Stride {
        /// Bytes from row to row.
        stride: u32,
        /// Pixels in a row.
        width: u32,
    },
    /// A curve that cannot be undone.
    #[error("a transfer curve with gamma {gamma} (0.1 to 10 are allowed)")]
    Gamma {
        /// The exponent.
        gamma: f32,
    },
    /// A quaternion that is no rotation.
    #[error("a rotation whose quaternion has length {norm} instead of 1")]
    Rotation {
        /// Its length.
        norm: f64,
    },
    /// A ray that is no direction.
    #[error("a ray of length {norm} instead of 1")]
    Ray {
        /// Its length.
        norm: f64,
    },
    /// A focal length that gives no picture.
    #[error("a focal length of {focal_px} pixels")]
    Focal {
        /// Pixels.
        focal_px: f64,
    },
    /// A number that is none, or out of all bounds.
    #[error("{what} is not a finite number within its bounds")]
    NotFinite {
        /// Which.
        what: &'static str,
    },
    /// More than anybody can mean.
    #[error("{found} {what} (at most {max} are allowed)")]
    TooMany {
        /// Of what.
        what: &'static str,
        /// How many came.
        found: usize,
        /// The most allowed.
        max: usize,
    },
    /// Something that must be there is not.
    #[error("the {what} is missing")]
    Missing {
        /// What.
        what: &'static str,
    },
}

/// One publish-subscribe service: messages of one header and a slice of items.
pub trait Topic {
    /// The iceoryx2 user header.
    type Header: ZeroCopySend + Pod + Default + Debug;
    /// The iceoryx2 payload is `[Item]`.
    type Item: ZeroCopySend + Pod + Debug;
    /// Name of the service and of the event service that wakes its subscribers.
    const NAME: &'static str;

    /// Refuses a message that is not what it says, before anybody reads it.
    ///
    /// # Errors
    /// The first thing about the message that cannot be.
    fn check(header: &Self::Header, items: &[Self::Item]) -> Result<(), ContractError>;
}

macro_rules! topics {
    ($($(#[$doc:meta])* $name:ident = $service:literal, $header:ty, [$item:ty], |$h:ident, $i:ident| $check:expr;)+) => {
        $(
            $(#[$doc])*
            #[derive(Debug, Clone, Copy)]
            pub enum $name {}

            impl Topic for $name {
                type Header = $header;
                type Item = $item;
                const NAME: &'static str = $service;

                fn check($h: &$header, $i: &[$item]) -> Result<(), ContractError> {
                    $check
                }
            }
        )+

        /// Names of all topics.
        pub const ALL_TOPICS: &[&str] = &[$($service),+];
    };
}

topics! {
    /// Source to rectification: the luma plane of the whole sphere.
    Frames = "flockeye/frame", FrameHeader, [u8], |header, items| header.check(items.len());
    /// Fusion to rectification (and, in a lossless run, to the source): where to look.
    Plans = "flockeye/plan", PlanHeader, [PlannedView], |header, items| header.check(items);
    /// Rectification to detection and fusion: a square pinhole image.
    Views = "flockeye/view", ViewHeader, [u8], |header, items| header.check(items.len());
    /// Detection to rectification and fusion: what a view holds.
    Detections = "flockeye/detection", DetectionHeader, [DetectedMarker], |header, items| header.check(items);
    /// Rectification to fusion: no more views of a frame will come.
    FrameEnds = "flockeye/frame_end", FrameEnd, [u8], |header, _items| header.check();
    /// Fusion to whoever wants to know: the neighbours' poses.
    Tracks = "flockeye/track", TrackHeader, [Track], |_header, items| items.iter().try_for_each(Track::check);
    /// Every stage to the launcher.
    Healths = "flockeye/health", Health, [u8], |header, _items| header.check();
    /// Simulator to evaluation.
    Truths = "flockeye/truth", TruthHeader, [BodyTruth], |header, items| header.check(items);
}
