//! Options and results of an alignment.

use flockeye_geometry::pose::PoseEstimate;
use nalgebra::{Isometry3, Matrix5, Matrix6, Vector5};

use super::evidence::Evidence;

/// Options of an alignment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AlignOptions {
    /// Expected standard deviation of the lens's point spread, pixels of the sphere image.
    pub blur_px: f64,
    /// Most pixels of the patch across a body: nearer bodies are averaged to a coarser resolution.
    pub max_body_px: f64,
    /// Most Gauss-Newton steps.
    pub max_iterations: usize,
    /// Whether to fit with more blur first, for a start with an error above half a cell.
    pub coarse_first: bool,
    /// Pose that the body's track predicts. It guides the fit where the picture says little. The last
    /// step is made without it, so that the result is a measurement of its own.
    pub predicted: Option<PoseEstimate>,
    /// Factor on the covariance for errors of lens and body, which the pixels do not show.
    pub covariance_scale: f64,
    /// Additional factor for the coding: 1 for single pictures, or [`VIDEO_COVARIANCE_SCALE`].
    pub coding_covariance_scale: f64,
}

/// Factor on the covariance in video, for errors that residuals do not show. A copied block is
/// sharp, but may be shifted by a fraction of a pixel. The factor comes from one recording; others
/// need less (docs/results/codings.md).
pub const VIDEO_COVARIANCE_SCALE: f64 = 3.1;

impl Default for AlignOptions {
    fn default() -> Self {
        Self {
            blur_px: 0.9,
            max_body_px: 75.0,
            max_iterations: 8,
            coarse_first: false,
            predicted: None,
            covariance_scale: 1.0,
            coding_covariance_scale: 1.0,
        }
    }
}

/// A body aligned with a view.
#[derive(Debug, Clone, PartialEq)]
pub struct Alignment {
    /// The pose of the body's markers in the camera frame.
    pub camera_from_markers: Isometry3<f64>,
    /// Its covariance: position (m), then rotation vector (rad), in the camera frame's axes.
    pub covariance: Matrix6<f64>,
    /// Whether the pose is usable by itself, see [`is_precise`](super::is_precise).
    /// [`VIDEO_COVARIANCE_SCALE`] is not included: video scatters poses, and none was false in the
    /// flights of docs/results/codings.md.
    pub is_precise: bool,
    /// Variance of the point spread along the apparent motion, less that across it, pixels of the
    /// sphere image squared. `None` without a known motion. It depends on the exposure time.
    pub stretch_px2: Option<f64>,
    /// Agreement of the cells with the image, with uniform radiance on each facet.
    pub evidence: Evidence,
    /// Share of the samples without an occlusion.
    pub visible_share: f64,
    /// The camera's response as the print shows it. `None` where it shows nothing of it.
    pub response: Option<SeenResponse>,
    /// What a body across the border of a stitched picture shows of the camera.
    pub stitch: Option<SeenStitch>,
}

/// The camera's response from light to code values, as the print of one body shows it.
///
/// Where the response differs from the assumed one, black cells look wider than white ones, or
/// narrower.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SeenResponse {
    /// Its exponent: code = light^(1/gamma).
    pub gamma: f64,
    /// Variance of `gamma`, from this body's pixels alone.
    pub variance: f64,
}

/// The constants of a stitched camera ([`Stitch`](flockeye_geometry::camera::Stitch)), as a body on
/// the border of its halves shows them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SeenStitch {
    /// Their inverse covariance, by the picture alone.
    pub information: Matrix5<f64>,
    /// The information times the constants.
    pub moment: Vector5<f64>,
}

impl Alignment {
    /// The pose with its covariance.
    pub fn pose(&self) -> PoseEstimate {
        let Self { camera_from_markers, covariance, .. } = *self;
        PoseEstimate { camera_from_markers, covariance }
    }
}

/// Reason why nothing was aligned.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum AlignError {
    /// The view does not show the place, or the pose or the view is not finite.
    #[error("the view does not hold the body at that pose")]
    NotInView,
    /// Too little of the body faces the camera, or the fit did not converge.
    #[error("too little of the body can be compared with the view there")]
    Nothing,
}
