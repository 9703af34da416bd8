//! Why a message was refused.

use crate::UnknownCode;

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
    /// A transfer curve that cannot be inverted.
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
    /// A number that is not finite, or out of bounds.
    #[error("{what} is not a finite number within its bounds")]
    NotFinite {
        /// Which.
        what: &'static str,
    },
    /// More items than allowed.
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
