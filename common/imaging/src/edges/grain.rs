//! How alike the noise of neighbouring pixels is.

use crate::sphere::MAGNIFIED;

/// Whose noise an image's pixels carry.
///
/// A view cut from a sphere resamples it: where it is magnified, many of its pixels say what a few of
/// the sphere's did, and all of them together know no more than those.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Grain {
    /// Each pixel its own.
    Pixels,
    /// A view's, whose pixels were interpolated.
    Resampled {
        /// Pixels of the view for each of the image it was cut from, along either axis.
        magnification: f64,
    },
}

/// Noise of a magnified image after cubic interpolation, along either axis: its variance, against
/// what it is for detail as fine as a lens lets through. Between 0.83, for detail without end, and
/// that of finer detail, which interpolation takes away. Measured (`tests/corners.rs`).
const CUBIC: f64 = 0.75;

impl Grain {
    /// How far apart pixels that say something new are, in whole pixels of an image blurred by a
    /// Gaussian of this standard deviation.
    pub(super) fn step(self, blur_px: f64) -> usize {
        match self {
            Self::Pixels => 1,
            // A Gaussian is known by places as far apart as it is wide.
            Self::Resampled { magnification } => {
                magnification.min(blur_px / 0.9).floor().clamp(1.0, 8.0) as usize
            }
        }
    }

    /// By how much the variance of what pixels `step` apart say together is larger than if their
    /// noise was their own; `alike` is the correlation of neighbours' residuals along either axis.
    pub(super) fn together(self, step: usize, alike: [f64; 2]) -> f64 {
        match self {
            Self::Pixels => 1.0,
            Self::Resampled { magnification } if magnification <= MAGNIFIED => {
                // Interpolated bilinearly: how much is shared depends on where the pixels fall
                // between those of the image.
                alike.map(|alike| 1.0 + 2.0 * alike.clamp(0.0, 0.5)).iter().product()
            }
            Self::Resampled { magnification } => {
                let pixels = step as f64 / magnification;
                (1.0 / (pixels * CUBIC)).max(1.0).powi(2)
            }
        }
    }
}
