//! Errors of refused messages, and the checks that several messages share.

/// Reason of a refused message.
#[expect(missing_docs, reason = "the texts name the fields")]
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum ContractError {
    /// An enumeration's code is unknown.
    #[error("unknown {what} code {code}")]
    Code { what: &'static str, code: u32 },
    /// The header announces more bytes than were sent.
    #[error("the header announces {needed} bytes of payload, {found} are there")]
    PayloadTooShort { needed: usize, found: usize },
    /// Zero or excessive size of an image.
    #[error("an image of {width}x{height} pixels (1 to {max} are allowed)")]
    Size { width: u32, height: u32, max: u32 },
    /// Overlapping or excessively distant rows.
    #[error("rows of {width} pixels that are {stride} bytes apart")]
    Stride { stride: u32, width: u32 },
    /// A transfer curve that cannot be inverted.
    #[error("a transfer curve with gamma {gamma} (0.1 to 10 are allowed)")]
    Gamma { gamma: f32 },
    /// The quaternion is no rotation.
    #[error("a rotation whose quaternion has length {norm} instead of 1")]
    Rotation { norm: f64 },
    /// The ray is no direction.
    #[error("a ray of length {norm} instead of 1")]
    Ray { norm: f64 },
    /// The focal length gives no image.
    #[error("a focal length of {focal_px} pixels")]
    Focal { focal_px: f64 },
    /// The number is not finite, or out of bounds.
    #[error("{what} is not a finite number within its bounds")]
    NotFinite { what: &'static str },
    /// More items than allowed.
    #[error("{found} {what} (at most {max} are allowed)")]
    TooMany { what: &'static str, found: usize, max: usize },
    /// A required value is missing.
    #[error("the {what} is missing")]
    Missing { what: &'static str },
}

/// Refuses more items than `max`.
pub(crate) fn check_count(
    what: &'static str,
    found: usize,
    max: usize,
) -> Result<(), ContractError> {
    if found > max { Err(ContractError::TooMany { what, found, max }) } else { Ok(()) }
}

/// Refuses numbers that are not finite.
pub(crate) fn check_finite(what: &'static str, numbers: &[f64]) -> Result<(), ContractError> {
    match numbers.iter().all(|number| number.is_finite()) {
        true => Ok(()),
        false => Err(ContractError::NotFinite { what }),
    }
}

/// Refuses quaternions that are no rotations.
pub(crate) fn check_unit(quaternion: &[f64; 4]) -> Result<(), ContractError> {
    let norm = quaternion.iter().map(|q| q * q).sum::<f64>().sqrt();
    // NaN compares false, so it is refused too.
    let is_unit = (norm - 1.0).abs() < 1e-3;
    if is_unit { Ok(()) } else { Err(ContractError::Rotation { norm }) }
}
