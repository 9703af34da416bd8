//! A view's message as its geometry and its pixels.

use flockeye_contract::ViewHeader;
use flockeye_geometry::view::View;
use flockeye_imaging::image::{ImageError, LumaImage};
use flockeye_imaging::light::LightError;

use crate::pose::rotation;

/// Why a view cannot be looked into.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ViewError {
    /// Its pixels are not as many as its header says.
    #[error(transparent)]
    Image(#[from] ImageError),
    /// Its curve cannot be undone.
    #[error(transparent)]
    Light(#[from] LightError),
    /// Its curve is a table that was not configured.
    #[error(
        "its curve is a table, but the configuration has none. Cure: set camera.response to table, \
         and camera.response_table"
    )]
    NoTable,
}

/// The geometry that a header states. The rotation is normalised; whether it was one is for the
/// contract's check to say.
pub fn view_of(header: &ViewHeader) -> View {
    View {
        camera_from_view: rotation(header.camera_from_view),
        focal_px: header.focal_px,
        size_px: header.size_px,
    }
}

/// The pixels that a header states, in a message's items.
///
/// # Errors
/// Too few of them.
pub fn image_of<'p>(header: &ViewHeader, pixels: &'p [u8]) -> Result<LumaImage<'p>, ViewError> {
    let size = header.size_px as usize;
    Ok(LumaImage::new(pixels, size, size, header.stride as usize)?)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    #[test]
    fn a_view_shorter_than_it_says_is_refused() {
        let header = ViewHeader { size_px: 10, stride: 10, ..ViewHeader::default() };
        assert!(image_of(&header, &[0; 99]).is_err());
        assert_eq!(image_of(&header, &[0; 100]).unwrap().height(), 10);
    }
}
