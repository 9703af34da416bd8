//! What can be wrong with a camera.

/// Why there is no such camera.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum CameraError {
    /// The image has too few pixels.
    #[error("an image of {width}x{height} pixels shows no sphere: both sides must be 2 or more")]
    Sides {
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
    },
    /// An image circle of which a part is missing.
    #[error(
        "the image circle of lens {lens}, {radius_px} px round ({u}, {v}), leaves the image of \
         {width}x{height} px; correct its centre or radius, or the image's sides"
    )]
    CircleOutside {
        /// 0 or 1.
        lens: usize,
        /// Radius of the circle, pixels.
        radius_px: f64,
        /// Its middle's column.
        u: f64,
        /// Its middle's row.
        v: f64,
        /// Columns of the image.
        width: u32,
        /// Rows of the image.
        height: u32,
    },
    /// A pixel would belong to two lenses.
    #[error("the two image circles overlap by {overlap_px:.1} px; correct their centres or radii")]
    CirclesOverlap {
        /// By how much, pixels.
        overlap_px: f64,
    },
    /// A number that no lens has.
    #[error("lens {lens}: {what} is {value}; it must be {must}")]
    Lens {
        /// 0 or 1.
        lens: usize,
        /// Which number.
        what: &'static str,
        /// What was given.
        value: f64,
        /// What is allowed.
        must: &'static str,
    },
    /// Two angles would fall on one pixel.
    #[error(
        "lens {lens}: its curve does not rise any more {angle_deg:.1} degrees from the axis, within \
         its field of {field_deg:.1} degrees; correct the coefficients or make the field smaller"
    )]
    Curve {
        /// 0 or 1.
        lens: usize,
        /// Where, degrees from the axis.
        angle_deg: f64,
        /// The field asked for, degrees across.
        field_deg: f64,
    },
    /// A stereographic image of nothing, or of more than there is.
    #[error("a stereographic field of {:.1} degrees; 1 to 350 can be used", .field_rad.to_degrees())]
    Field {
        /// Angle across the circle, radians.
        field_rad: f64,
    },
    /// Lenses farther apart than the camera is from anything it sees.
    #[error("lenses {metres} m from the camera's middle; 0 to {MAX_OFFSET_M} m can be used")]
    Offset {
        /// How far, metres.
        metres: f64,
    },
}

/// Lenses farther from the camera's middle than this are refused, metres.
pub const MAX_OFFSET_M: f64 = 0.5;

/// Refuses a lens that sits too far from the camera's middle.
pub(super) fn check_offset(metres: f64) -> Result<(), CameraError> {
    // Written so that NaN is refused too.
    if (0.0..=MAX_OFFSET_M).contains(&metres) {
        Ok(())
    } else {
        Err(CameraError::Offset { metres })
    }
}
