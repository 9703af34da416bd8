//! Errors of a camera's configuration.

/// Reason why a camera or its mask is not valid.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say what the fields are")]
pub enum CameraError {
    /// The image has too few pixels.
    #[error("an image of {width}x{height} pixels shows no sphere: both sides must be 2 or more")]
    Sides { width: u32, height: u32 },
    /// An image circle that is partly outside the image.
    #[error(
        "the image circle of lens {lens}, {radius_px} px round ({u}, {v}), leaves the image of \
         {width}x{height} px; correct its centre or radius, or the image's sides"
    )]
    CircleOutside { lens: usize, radius_px: f64, u: f64, v: f64, width: u32, height: u32 },
    /// Two image circles overlap, so that a pixel would belong to two lenses.
    #[error("the two image circles overlap by {overlap_px:.1} px; correct their centres or radii")]
    CirclesOverlap { overlap_px: f64 },
    /// A value that no lens has.
    #[error("lens {lens}: {what} is {value}; it must be {must}")]
    Lens { lens: usize, what: &'static str, value: f64, must: &'static str },
    /// Two angles would have the same pixel.
    #[error(
        "lens {lens}: its curve does not rise any more {angle_deg:.1} degrees from the axis, within \
         its field of {field_deg:.1} degrees; correct the coefficients or make the field smaller"
    )]
    Curve { lens: usize, angle_deg: f64, field_deg: f64 },
    /// A stereographic image with a field of zero, or of more than the sphere.
    #[error("a stereographic field of {:.1} degrees; 1 to 350 can be used", .field_rad.to_degrees())]
    Field { field_rad: f64 },
    /// A mask whose size differs from that of the frames.
    #[error(
        "it has {}x{} pixels, frames have {}x{}. Cure: draw the mask on a frame of this camera",
        .mask[0], .mask[1], .frame[0], .frame[1]
    )]
    MaskSides { mask: [u32; 2], frame: [u32; 2] },
    /// Lenses that are farther apart than the nearest objects.
    #[error("lenses {metres} m from the camera's middle; 0 to {MAX_OFFSET_M} m can be used")]
    Offset { metres: f64 },
}

/// Largest distance of a lens from the camera's middle, metres.
pub const MAX_OFFSET_M: f64 = 0.5;

/// Refuses a lens that sits too far from the camera's middle.
pub(super) fn check_offset(metres: f64) -> Result<(), CameraError> {
    // In this form NaN is refused too.
    if (0.0..=MAX_OFFSET_M).contains(&metres) {
        Ok(())
    } else {
        Err(CameraError::Offset { metres })
    }
}
