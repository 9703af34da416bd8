//! The image of a spherical camera.

use flockeye_geometry::camera::{Camera, CameraModel};

use super::error::{MAX_SIDE_PX, SphereError};

/// The luma plane of a spherical camera's image.
#[derive(Debug, Clone, Copy)]
pub struct SphereImage<'a> {
    pub(super) pixels: &'a [u8],
    pub(super) stride: usize,
    pub(super) camera: Camera,
}

impl<'a> SphereImage<'a> {
    /// An image with rows as wide as the camera's, `stride` bytes apart. Bytes between rows are
    /// ignored.
    ///
    /// # Errors
    /// Sides out of range, overlapping rows, or a slice that ends before the last pixel. The width
    /// of an equirectangular image must be even, because half a turn must be whole pixels.
    pub fn new(pixels: &'a [u8], stride: usize, camera: Camera) -> Result<Self, SphereError> {
        let (width, height) = (camera.width(), camera.height());
        let sides = 2..=MAX_SIDE_PX;
        let must_be_even = matches!(camera.model(), CameraModel::Equirectangular { .. });
        if !sides.contains(&width)
            || !sides.contains(&height)
            || (must_be_even && !width.is_multiple_of(2))
        {
            return Err(SphereError::Sides { width, height });
        }
        if stride < width as usize {
            return Err(SphereError::Stride { stride, width });
        }
        let needed = stride.saturating_mul(height as usize - 1).saturating_add(width as usize);
        if pixels.len() < needed {
            let found = pixels.len();
            return Err(SphereError::TooShort { what: "the sphere image", needed, found });
        }
        Ok(Self { pixels, stride, camera })
    }

    /// The bytes, row by row.
    pub fn pixels(&self) -> &'a [u8] {
        self.pixels
    }

    /// Bytes from one row to the next.
    pub fn stride(&self) -> usize {
        self.stride
    }

    /// The camera model, with the image's sides.
    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// Whether columns wrap around and rows continue beyond the poles.
    pub(super) fn is_round(&self) -> bool {
        matches!(self.camera.model(), CameraModel::Equirectangular { .. })
    }
}
