//! Errors of cutting views.

/// Longest side of a sphere image or a view, pixels.
pub const MAX_SIDE_PX: u32 = 16_384;

/// Reason why no view was cut.
#[allow(missing_docs, reason = "the messages say what each is")]
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SphereError {
    #[error(
        "a sphere image of {width} x {height} px cannot be sampled; sides of 2 to {MAX_SIDE_PX} px \
         can, of an equirectangular one with an even width"
    )]
    Sides { width: u32, height: u32 },
    #[error("rows of {width} px cannot be {stride} bytes apart; the stride must be at least that")]
    Stride { stride: usize, width: u32 },
    #[error("{what} needs {needed} bytes, but its buffer holds {found}")]
    TooShort { what: &'static str, needed: usize, found: usize },
    #[error(
        "a view of {size_px} px with focal length {focal_px} px cannot be cut; it needs 1 to \
         {MAX_SIDE_PX} px, a positive focal length and a unit quaternion"
    )]
    View { size_px: u32, focal_px: f64 },
    #[error("{views} views need as many outputs, but there are {outputs}")]
    Outputs { views: usize, outputs: usize },
}
