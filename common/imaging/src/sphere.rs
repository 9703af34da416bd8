//! Cuts views from the image of a spherical camera: square gnomonic images.
//!
//! A view is divided into tiles. The mapping from its pixels to the sphere image is evaluated
//! exactly at nine points of a tile and interpolated quadratically between them, in integers of
//! 1/65536 px. The error is at most [`MAX_MAPPING_ERROR_PX`]. Where that is not possible, a tile is
//! split, down to single pixels: next to a pole, where the columns converge, and along the border
//! between two lenses. Nothing is precomputed for a view, so moving and fixed views cost the same.
//!
//! Pixels are interpolated bilinearly or by a cubic. In an equirectangular image the first and the
//! last column are neighbours. Beyond the first and the last row lies the same row, half a turn
//! further. Pixels outside the camera's field are black.
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
mod accuracy_tests;
mod angle;
mod any_camera;
#[cfg(target_arch = "x86_64")]
mod avx2;
mod cubic;
mod cut;
mod cut_request;
mod equirectangular;
mod error;
#[cfg(target_arch = "x86_64")]
mod fetch;
mod fixed_point;
mod image;
mod mapping;
mod patch;
mod sample;

pub use cut_request::{Cut, Interpolation, MAGNIFIED};
pub use error::{MAX_SIDE_PX, SphereError};
pub use fixed_point::MAX_MAPPING_ERROR_PX;
pub use image::SphereImage;

/// The vector instructions used on this processor, for logs and benchmarks.
pub fn instructions() -> &'static str {
    cut::Kernel::of_processor().name()
}

/// Cuts one view into `out`, with rows `out_stride` bytes apart, on the calling thread.
///
/// The result is within 2 grey levels, and 0.5 on average, of exact sampling, for a picture as
/// sharp as a camera's (blurred by 0.8 px).
///
/// # Errors
/// A view without content, overlapping rows, or an `out` that is too short for the view.
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

/// Cuts several views into `outputs`, with rows as far apart as a view is wide, on up to `threads`
/// threads. The bytes do not depend on the number of threads.
///
/// # Errors
/// As [`rectify_into`], or if there are not as many outputs. Then nothing is written.
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

/// Refuses views that cannot be cut into `outputs`, with rows as far apart as a view is wide.
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
    use flockeye_geometry::camera::Camera;
    use flockeye_geometry::view::View;
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
