//! Tried poses of a body, with all data for a decision.

use flockeye_geometry::pose::PoseSolution;
use flockeye_imaging::align::{AlignError, Alignment};
use nalgebra::Isometry3;

/// A pose that was compared with the picture.
#[derive(Debug, Clone, PartialEq)]
pub struct Hypothesis {
    /// Source of the start.
    pub source: StartSource,
    /// Result of the alignment, or the reason why there is none.
    pub found: Result<Alignment, AlignError>,
    /// Log odds from the rotation relative to the track's prediction; `None` without a confirmed
    /// track.
    pub turn_log: Option<f64>,
    /// Log odds from the usual attitude of neighbours, where hypotheses compete.
    pub tilt_log: f64,
    /// Whether markers were decoded at the places of this pose.
    pub is_marked: bool,
}

/// Source of a hypothesis.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StartSource {
    /// Corners of decoded markers.
    Corners,
    /// The track's prediction. An ambiguous track has two.
    Prediction,
    /// The track's prediction, with a coarse fit before the fine one.
    RoughPrediction,
    /// The direct pass, which tried the prediction before.
    DirectPass,
    /// The mirror pose of another hypothesis.
    Mirror,
    /// The search in all attitudes at a place that looks like a body.
    Place,
}

impl StartSource {
    /// Whether the start is the track's prediction.
    pub(crate) fn is_prediction(self) -> bool {
        matches!(self, Self::Prediction | Self::RoughPrediction)
    }
}

impl Hypothesis {
    /// A pose with the result of its alignment alone.
    pub fn of(source: StartSource, found: Result<Alignment, AlignError>) -> Self {
        Self { source, found, turn_log: None, tilt_log: 0.0, is_marked: false }
    }

    /// A pose, and whether markers were decoded at its places.
    pub(crate) fn marked(
        source: StartSource,
        found: Result<Alignment, AlignError>,
        is_marked: impl Fn(&Isometry3<f64>) -> bool,
    ) -> Self {
        let is_marked = found.as_ref().is_ok_and(|found| is_marked(&found.camera_from_markers));
        Self { is_marked, ..Self::of(source, found) }
    }

    pub(crate) fn alignment(&self) -> Option<&Alignment> {
        self.found.as_ref().ok()
    }

    /// Log odds of the picture and of the other evidence.
    pub fn log_odds(&self) -> Option<f64> {
        let picture = self.alignment()?.evidence.log_odds;
        Some(picture + self.turn_log.unwrap_or(0.0) + self.tilt_log)
    }
}

/// A pose from decoded corners.
#[derive(Debug, Clone, PartialEq)]
pub struct CornerPose {
    /// The pose and its support.
    pub solution: PoseSolution,
    /// Whether corners and track prefer this pose.
    pub is_chosen: bool,
    /// Whether the pose is acceptable as the frame's measurement if the picture gives none.
    pub verdict: CornerVerdict,
}

/// Verdict on a pose from corners as a measurement.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum CornerVerdict {
    /// The pose is acceptable.
    Enough,
    /// Too few markers fit.
    TooFewMarkers {
        /// The required number.
        wanted: usize,
    },
    /// One marker fits, and the track's prediction is not certain enough to rule out that it is
    /// misread or blurred. The pose may only correct the track.
    OneMarker,
    /// Another pose explains the corners and the track almost as well: the lead, in log odds.
    Ambiguous {
        /// Log odds of the chosen pose against all others.
        lead: f64,
    },
    /// Its standard deviations, all axes together, are too large. It may only correct a track.
    TooUncertain {
        /// Metres.
        position_m: f64,
        /// Radians.
        rotation_rad: f64,
    },
}
