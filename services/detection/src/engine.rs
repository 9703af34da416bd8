//! Choice of the detector that searches the views (`detection.engine`).

use flockeye_config::DetectionEngine;
use flockeye_dictionary::Dictionary;
use flockeye_geometry::mask::Mask;
use flockeye_geometry::view::View;
use flockeye_imaging::image::LumaImage;
use flockeye_imaging::light::LinearLight;

use crate::detector::{Detector, MarkerInView};
use crate::opencv_detector::OpenCvDetector;
use crate::parameters::{DetectError, DetectorParameters};
use crate::windows::Threshold;

/// A detector for one dictionary.
pub enum Engine {
    /// Flockeye's own detector.
    Own(Box<Detector>),
    /// OpenCV's detector, with its default parameters.
    OpenCv(Box<OpenCvDetector>),
}

impl Engine {
    /// The detector of this kind for the dictionary of this name. `parameters` apply to our
    /// own detector alone.
    ///
    /// # Errors
    /// An unknown dictionary, a broken file, or a parameter outside its range.
    pub fn new(
        kind: DetectionEngine,
        dictionary: &str,
        parameters: DetectorParameters,
    ) -> Result<Self, DetectError> {
        Ok(match kind {
            DetectionEngine::Own => Self::Own(Box::new(Detector::new(dictionary, parameters)?)),
            DetectionEngine::OpenCv => Self::OpenCv(Box::new(OpenCvDetector::new(dictionary)?)),
        })
    }

    /// Leaves out markers on what `mask` hides.
    pub fn with_mask(self, mask: Mask) -> Self {
        match self {
            Self::Own(detector) => Self::Own(Box::new(detector.with_mask(mask))),
            Self::OpenCv(detector) => Self::OpenCv(Box::new(detector.with_mask(mask))),
        }
    }

    /// The dictionary.
    pub fn dictionary(&self) -> &Dictionary {
        match self {
            Self::Own(detector) => detector.dictionary(),
            Self::OpenCv(detector) => detector.dictionary(),
        }
    }

    /// Finds every marker in `image`, the picture of `view`, by rising id.
    /// `image` has `magnification` pixels for each of the sphere image, along either axis.
    ///
    /// # Errors
    /// Thresholds that are invalid for every image; errors of OpenCV.
    pub fn detect(
        &mut self,
        image: &LumaImage<'_>,
        view: &View,
        light: &LinearLight,
        magnification: f64,
        thresholds: impl Iterator<Item = Threshold> + Clone,
    ) -> Result<Vec<MarkerInView>, DetectError> {
        match self {
            Self::Own(detector) => {
                detector.set_thresholds(thresholds)?;
                detector.set_magnification(magnification);
                Ok(detector.detect(image, view, light))
            }
            Self::OpenCv(detector) => detector.detect(image, view),
        }
    }
}
