//! Poses of a body that were tried, with all that a decision about them needs.

use flockeye_geometry::pose::PoseSolution;
use flockeye_imaging::align::{AlignError, Alignment};
use nalgebra::Isometry3;

/// A pose that was compared with the picture.
#[derive(Debug, Clone, PartialEq)]
pub struct Hypothesis {
    /// Source of the start.
    pub source: StartSource,
    /// What alignment found, or why it found nothing.
    pub found: Result<Alignment, AlignError>,
    /// What the turn from the track's prediction adds to the log odds; `None` without a confirmed
    /// track.
    pub turn_log: Option<f64>,
    /// What is known of how neighbours fly adds to the log odds, where hypotheses compete.
    pub tilt_log: f64,
    /// Whether markers were decoded where this pose has them.
    pub is_marked: bool,
}

/// Where a hypothesis comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StartSource {
    /// Corners of decoded markers.
    Corners,
    /// Corners of squares that are probably markers.
    DoubtfulSquares,
    /// The track's prediction.
    Prediction,
    /// The track's prediction, with a coarse fit before the fine one.
    RoughPrediction,
    /// The direct pass, which has tried the prediction before.
    DirectPass,
    /// The mirror pose of another hypothesis.
    Mirror,
    /// The search round the prediction.
    Search,
    /// The search in all attitudes at a place that looks like a body.
    Place,
}

impl Hypothesis {
    /// A pose of which nothing is known but what alignment found.
    pub fn of(source: StartSource, found: Result<Alignment, AlignError>) -> Self {
        Self { source, found, turn_log: None, tilt_log: 0.0, is_marked: false }
    }

    /// A pose, and whether markers were decoded where it has them.
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

    /// The log odds of the picture and of what else counted.
    pub fn log_odds(&self) -> Option<f64> {
        let picture = self.alignment()?.evidence.log_odds;
        Some(picture + self.turn_log.unwrap_or(0.0) + self.tilt_log)
    }
}

/// A pose from decoded corners.
#[derive(Debug, Clone, PartialEq)]
pub struct CornerPose {
    /// The pose and what supports it.
    pub solution: PoseSolution,
    /// Whether corners and track prefer this pose.
    pub is_chosen: bool,
    /// Whether the pose would do as the frame's measurement, where the picture gives none.
    pub verdict: CornerVerdict,
}

/// Whether a pose from corners would do as a measurement.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum CornerVerdict {
    /// The pose would do.
    Enough,
    /// More markers would have to agree.
    TooFewMarkers {
        /// The number that is asked for.
        wanted: usize,
    },
    /// Its standard deviations are too large, all axes together. It may only correct a track.
    TooUncertain {
        /// Metres.
        position_m: f64,
        /// Radians.
        rotation_rad: f64,
    },
}
