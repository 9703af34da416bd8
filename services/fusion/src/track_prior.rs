//! Prediction of a target from its track, before a frame measures it.

use flockeye_geometry::pose::PoseEstimate;
use nalgebra::Isometry3;

/// Prediction of a target from its track, before a frame measures it.
#[derive(Debug, Clone)]
#[allow(clippy::large_enum_variant, reason = "one for each target and pass, on the stack")]
pub enum TrackPrior {
    /// There is no track.
    Untracked,
    /// A track that is not confirmed yet, or that is ambiguous: starts, but no prior.
    Tentative {
        /// The likeliest pose.
        predicted: PoseEstimate,
        /// The rival (`camera_from_markers`) of an ambiguous track.
        rival: Option<Isometry3<f64>>,
    },
    /// A confirmed track.
    Confirmed(PoseEstimate),
}

impl TrackPrior {
    /// The prediction, confirmed or not.
    pub(crate) fn predicted(&self) -> Option<&PoseEstimate> {
        match self {
            Self::Untracked => None,
            Self::Tentative { predicted, .. } | Self::Confirmed(predicted) => Some(predicted),
        }
    }

    /// The predicted `camera_from_markers` of an ambiguous track's rival.
    pub(crate) fn rival(&self) -> Option<&Isometry3<f64>> {
        match self {
            Self::Tentative { rival, .. } => rival.as_ref(),
            Self::Untracked | Self::Confirmed(_) => None,
        }
    }

    /// The prediction of a confirmed track.
    pub(crate) fn confirmed(&self) -> Option<&PoseEstimate> {
        match self {
            Self::Confirmed(prior) => Some(prior),
            Self::Untracked | Self::Tentative { .. } => None,
        }
    }
}
