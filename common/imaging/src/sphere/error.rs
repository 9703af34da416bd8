//! Why no view was cut.

/// Longest side of a sphere image or a view, pixels.
pub const MAX_SIDE_PX: u32 = 16_384;

/// Why no view was cut.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SphereError {
    /// The sides of the sphere image are out of range.
    #[error(
        "a sphere image of {width} x {height} px cannot be sampled; sides of 2 to {MAX_SIDE_PX} px \
         can, of an equirectangular one with an even width"
    )]
    Sides {
        /// Columns, pixels.
        width: u32,
        /// Rows, pixels.
        height: u32,
    },
    /// Rows overlap.
    #[error("rows of {width} px cannot be {stride} bytes apart; the stride must be at least that")]
    Stride {
        /// Bytes from one row to the next.
        stride: usize,
        /// Pixels in a row.
        width: u32,
    },
    /// A buffer is too short for its image.
    #[error("{what} needs {needed} bytes, but its buffer holds {found}")]
    TooShort {
        /// Which image.
        what: &'static str,
        /// Bytes from its first to its last pixel.
        needed: usize,
        /// Bytes that the buffer has.
        found: usize,
    },
    /// A view that shows nothing.
    #[error(
        "a view of {size_px} px with focal length {focal_px} px cannot be cut; it needs 1 to \
         {MAX_SIDE_PX} px, a positive focal length and a unit quaternion"
    )]
    View {
        /// Pixels along a side.
        size_px: u32,
        /// Focal length, pixels.
        focal_px: f64,
    },
    /// The numbers of views and buffers differ.
    #[error("{views} views need as many outputs, but there are {outputs}")]
    Outputs {
        /// Views to cut.
        views: usize,
        /// Buffers given.
        outputs: usize,
    },
}
