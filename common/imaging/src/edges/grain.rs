//! Correlation of the noise of neighbouring pixels.

use crate::sphere::MAGNIFIED;

/// Whether the pixels of an image have independent noise.
///
/// A view cut from a sphere image is resampled. Where it is magnified, many of its pixels depend on
/// a few of the sphere image's, and contain no more information than those.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Grain {
    /// Each pixel has noise of its own.
    Pixels,
    /// The pixels were interpolated from another image.
    Resampled {
        /// Pixels of the view for each pixel of the image it was cut from, along one axis.
        magnification: f64,
    },
}

/// Variance of the noise after cubic interpolation, along one axis, relative to that of independent
/// pixels, for detail as fine as a lens resolves. It is 0.83 for very coarse detail and less for
/// finer detail, which interpolation removes. Measured (`tests/corners.rs`).
const CUBIC: f64 = 0.75;

impl Grain {
    /// Distance between pixels that add information, in whole pixels of an image blurred by a
    /// Gaussian of this standard deviation.
    pub(super) fn step(self, blur_px: f64) -> usize {
        match self {
            Self::Pixels => 1,
            // Samples at distances of the Gaussian's width determine it.
            Self::Resampled { magnification } => {
                magnification.min(blur_px / 0.9).floor().clamp(1.0, 8.0) as usize
            }
        }
    }

    /// Variance of a mean over pixels `step` apart, relative to that with independent noise.
    /// `correlation` is that of neighbouring residuals along each axis.
    pub(super) fn variance_factor(self, step: usize, correlation: [f64; 2]) -> f64 {
        match self {
            Self::Pixels => 1.0,
            Self::Resampled { magnification } if magnification <= MAGNIFIED => {
                // For bilinear interpolation the correlation depends on the position between the
                // pixels of the image, so it is measured.
                correlation.map(|along| 1.0 + 2.0 * along.clamp(0.0, 0.5)).iter().product()
            }
            Self::Resampled { magnification } => {
                let pixels = step as f64 / magnification;
                (1.0 / (pixels * CUBIC)).max(1.0).powi(2)
            }
        }
    }
}
