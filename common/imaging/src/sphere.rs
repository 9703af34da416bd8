//! Views cut from the sphere: square gnomonic images sampled from a spherical camera's.
//!
//! The mapping from a view's pixels to the sphere's is evaluated exactly at nine points of a tile
//! and interpolated quadratically between them, in integers of 1/65536 px, within
//! [`MAX_MAPPING_ERROR_PX`]; tiles that cannot be are split, down to single pixels: next to a pole,
//! where the columns run together, and along the border between two lenses. So nothing is prepared
//! for a view, and one that moves with each frame costs the same as one that stands still. Pixels
//! are interpolated bilinearly or by a cubic; of an equirectangular image the first and the last
//! column are neighbours, and beyond the first and the last row lies the same row half a turn
//! further. What the camera does not see is black.
//!
//! ```
//! use flockeye_geometry::{camera::Camera, view::View};
//! use flockeye_imaging::sphere::{Cut, SphereImage, rectify_into};
//!
//! let pixels = vec![90u8; 640 * 320];
//! let sphere = SphereImage::new(&pixels, 640, Camera::equirectangular(640, 320))?;
//! let view = View::looking_at(&nalgebra::Vector3::x_axis(), 1.0, 100);
//! let mut out = vec![0u8; 100 * 100];
//! rectify_into(&sphere, &Cut::bilinear(view), &mut out, 100)?;
//! assert!(out.iter().all(|&grey| grey == 90));
//! # Ok::<(), flockeye_imaging::sphere::SphereError>(())
//! ```

#[cfg(test)]
mod accuracy;
mod angle;
mod any_camera;
#[cfg(target_arch = "x86_64")]
mod avx2;
mod cubic;
mod cut;
mod equirectangular;
#[cfg(target_arch = "x86_64")]
mod fetch;
mod mapping;
mod patch;
mod sample;

use flockeye_geometry::camera::{Camera, CameraModel};
use flockeye_geometry::view::View;

/// How far the interpolated mapping may lie from the exact one, pixels of the sphere image along
/// its rows and along its columns.
pub const MAX_MAPPING_ERROR_PX: f64 = 0.02;

/// Sides, of the sphere image and of views, longer than this are refused, pixels.
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
        /// Bytes that are there.
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
    /// Views and buffers do not pair up.
    #[error("{views} views need as many outputs, but there are {outputs}")]
    Outputs {
        /// Views to cut.
        views: usize,
        /// Buffers given.
        outputs: usize,
    },
}

/// The luma plane of a spherical camera's image.
#[derive(Debug, Clone, Copy)]
pub struct SphereImage<'a> {
    pixels: &'a [u8],
    stride: usize,
    camera: Camera,
}

/// A view to be cut.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cut {
    /// The view.
    pub view: View,
    /// The distance it is to be right for, metres: see [`Camera::at_distance`].
    pub distance_m: f64,
    /// How pixels are interpolated.
    pub interpolation: Interpolation,
}

/// How a grey value between pixels comes about.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Interpolation {
    /// From the four pixels around it.
    #[default]
    Bilinear,
    /// From the sixteen around it, by the cubic convolution that is exact for parabolas (Keys:
    /// *Cubic convolution interpolation for digital image processing*, 1981; Catmull-Rom). Sharper
    /// where a view is magnified, at about three times the cost.
    Cubic,
}

/// Views magnified more than this, against the sphere image, gain from cubic interpolation.
pub const MAGNIFIED: f64 = 1.25;

impl Interpolation {
    /// Cubic for magnified views, bilinear for others.
    pub fn suited_to(view: &View, camera: &Camera) -> Self {
        if view.focal_px > MAGNIFIED * camera.pixels_per_radian() {
            Self::Cubic
        } else {
            Self::Bilinear
        }
    }
}

impl Cut {
    /// A view of things far away, interpolated bilinearly.
    pub fn bilinear(view: View) -> Self {
        Self { view, distance_m: f64::INFINITY, interpolation: Interpolation::Bilinear }
    }

    /// A view of things far away, interpolated by the cubic.
    pub fn cubic(view: View) -> Self {
        Self { interpolation: Interpolation::Cubic, ..Self::bilinear(view) }
    }

    /// Refuses a view that shows nothing.
    ///
    /// # Errors
    /// [`SphereError::View`].
    pub fn check(&self) -> Result<(), SphereError> {
        let View { camera_from_view, focal_px, size_px } = self.view;
        // NaN compares false, so it is refused here too.
        let is_unit = (camera_from_view.norm() - 1.0).abs() < 1e-3;
        let is_lens = focal_px > 0.0 && focal_px.is_finite();
        if !is_unit || !is_lens || !(1..=MAX_SIDE_PX).contains(&size_px) {
            return Err(SphereError::View { size_px, focal_px });
        }
        Ok(())
    }
}

impl<'a> SphereImage<'a> {
    /// Rows of the camera's width in bytes, `stride` bytes apart; what lies between them is not
    /// looked at.
    ///
    /// # Errors
    /// Sides out of range (an equirectangular image's odd width among them: half a turn must be
    /// whole pixels), overlapping rows, a slice that ends before the last pixel.
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

    /// Whether columns go round and rows beyond the poles come back.
    fn is_round(&self) -> bool {
        matches!(self.camera.model(), CameraModel::Equirectangular { .. })
    }
}

/// The vector instructions that views are cut with on this processor, for logs and benchmarks.
pub fn instructions() -> &'static str {
    cut::Kernel::of_processor().name()
}

/// Cuts one view into `out`, rows `out_stride` bytes apart, on the calling thread.
///
/// Within 2 grey levels, and 0.5 on average, of exact sampling of a picture as sharp as a camera's
/// (blurred by 0.8 px).
///
/// # Errors
/// A view that shows nothing, overlapping rows, an `out` too short for the view.
pub fn rectify_into(
    sphere: &SphereImage<'_>,
    cut: &Cut,
    out: &mut [u8],
    out_stride: usize,
) -> Result<(), SphereError> {
    check_output(cut, out.len(), out_stride)?;
    cut::cut_view(sphere, cut, out, out_stride);
    Ok(())
}

/// Makes `cuts` into `outputs`, rows as far apart as a view is wide, on up to `threads` threads.
/// The same bytes come out whatever their number.
///
/// # Errors
/// As [`rectify_into`], and as many outputs as views are needed; nothing is written then.
pub fn rectify_all(
    sphere: &SphereImage<'_>,
    cuts: &[Cut],
    outputs: &mut [&mut [u8]],
    threads: usize,
) -> Result<(), SphereError> {
    check_outputs(cuts, outputs)?;
    cut::cut_views(sphere, cuts, outputs, threads);
    Ok(())
}

/// Refuses views that cannot be cut into `outputs`, rows as far apart as a view is wide.
///
/// # Errors
/// As [`rectify_all`].
pub fn check_outputs(cuts: &[Cut], outputs: &[&mut [u8]]) -> Result<(), SphereError> {
    if cuts.len() != outputs.len() {
        return Err(SphereError::Outputs { views: cuts.len(), outputs: outputs.len() });
    }
    cuts.iter()
        .zip(outputs)
        .try_for_each(|(cut, out)| check_output(cut, out.len(), cut.view.size_px as usize))
}

fn check_output(cut: &Cut, found: usize, stride: usize) -> Result<(), SphereError> {
    cut.check()?;
    let width = cut.view.size_px;
    let size = width as usize;
    if stride < size {
        return Err(SphereError::Stride { stride, width });
    }
    let needed = stride.saturating_mul(size - 1).saturating_add(size);
    if found < needed {
        return Err(SphereError::TooShort { what: "the view", needed, found });
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]

    use super::*;
    use nalgebra::Vector3;

    const CAMERA: Camera = Camera::equirectangular(64, 32);

    #[test]
    fn images_that_cannot_be_sampled_are_refused() {
        let pixels = [0u8; 64 * 32];
        let refuse = |len, stride, camera| SphereImage::new(&pixels[..len], stride, camera).err();
        assert_eq!(refuse(64 * 32, 64, CAMERA), None);
        let odd = Camera::equirectangular(63, 32);
        assert_eq!(refuse(64 * 32, 64, odd), Some(SphereError::Sides { width: 63, height: 32 }));
        let stride = SphereError::Stride { stride: 63, width: 64 };
        assert_eq!(refuse(64 * 32, 63, CAMERA), Some(stride));
        let short = SphereError::TooShort { what: "the sphere image", needed: 2048, found: 2047 };
        assert_eq!(refuse(64 * 32 - 1, 64, CAMERA), Some(short));
    }

    #[test]
    fn views_that_show_nothing_are_refused() {
        let pixels = [0u8; 64 * 32];
        let sphere = SphereImage::new(&pixels, 64, CAMERA).unwrap();
        let view = View::looking_at(&Vector3::x_axis(), 1.0, 10);
        let mut out = [0u8; 100];
        assert_eq!(rectify_into(&sphere, &Cut::bilinear(view), &mut out, 10), Ok(()));
        for focal_px in [0.0, -3.0, f64::NAN, f64::INFINITY] {
            let error =
                rectify_into(&sphere, &Cut::bilinear(View { focal_px, ..view }), &mut out, 10);
            assert!(matches!(error, Err(SphereError::View { .. })), "{focal_px}: {error:?}");
        }
        let empty = View { size_px: 0, ..view };
        assert!(matches!(
            rectify_into(&sphere, &Cut::bilinear(empty), &mut out, 10),
            Err(SphereError::View { size_px: 0, .. })
        ));
        let short = SphereError::TooShort { what: "the view", needed: 100, found: 99 };
        assert_eq!(rectify_into(&sphere, &Cut::bilinear(view), &mut out[..99], 10), Err(short));
        let stride = SphereError::Stride { stride: 9, width: 10 };
        assert_eq!(rectify_into(&sphere, &Cut::bilinear(view), &mut out, 9), Err(stride));
        let unpaired = SphereError::Outputs { views: 1, outputs: 0 };
        assert_eq!(rectify_all(&sphere, &[Cut::bilinear(view)], &mut [], 2), Err(unpaired));
    }
}
