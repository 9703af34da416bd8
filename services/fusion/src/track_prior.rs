//! Prediction of a target from its track, before a frame measures it.

use flockeye_geometry::pose::PoseEstimate;
use nalgebra::Isometry3;

/// Prediction of a target from its track, before a frame measures it.
#[derive(Debug, Clone)]
#[allow(clippy::large_enum_variant, reason = "one for each target and pass, on the stack")]
pub enum TrackPrior {
    /// There is no track.
    Untracked,
    /// A track that is not confirmed yet: a start pose (`camera_from_markers`), but no prior.
    Tentative(Isometry3<f64>),
    /// A confirmed track.
    Confirmed(PoseEstimate),
}

impl TrackPrior {
    /// The predicted `camera_from_markers`, confirmed or not.
    pub(crate) fn predicted(&self) -> Option<&Isometry3<f64>> {
        match self {
            Self::Untracked => None,
            Self::Tentative(pose) => Some(pose),
            Self::Confirmed(prior) => Some(&prior.camera_from_markers),
        }
    }

    /// The prediction of a confirmed track.
    pub(crate) fn confirmed(&self) -> Option<&PoseEstimate> {
        match self {
            Self::Confirmed(prior) => Some(prior),
            Self::Untracked | Self::Tentative(_) => None,
        }
    }
}
