//! What was decided of one body in each frame, and why: plain data for whoever asks afterwards.
//!
//! Each pass gives a [`Trial`] of its target: what it tried, the decision, and what became of it.
//! The tracker keeps the trials of one target for whoever asks; nothing is decided by them.

use nalgebra::Isometry3;

use crate::decide::outcome::Outcome;
use crate::decide::{self, Decision, Verdict};
use crate::hypothesis::{CornerPose, Hypothesis};
use crate::measurement::PoseMeasurement;
use crate::policy::TimeBudget;
use crate::track_prior::TrackPrior;

/// One thing that happened to the target in a frame.
#[derive(Debug, Clone, PartialEq)]
#[allow(clippy::large_enum_variant, reason = "a few for each frame that somebody asks about")]
pub enum AccountEntry {
    /// A pass was due, and did not run.
    NotRun(Pass, NotRun),
    /// A pass ran.
    Ran(Trial),
    /// Decoded markers contradict the pose of the direct pass: its target waits for its markers for
    /// a while.
    Contradicted,
    /// The frame is complete, and what only corrects the track was taken in.
    TakenImprecise(Outcome),
}

/// A measurement pass.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Pass {
    /// From the prediction alone.
    Direct,
    /// From markers and the prediction, when the region of interest was searched.
    Region,
    /// The corner pass over all of the complete frame.
    Complete,
    /// From rough starts, and a search round the prediction.
    Background,
    /// In any attitude, at a place that looks like a body.
    Place,
}

/// Why a pass did not run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NotRun {
    /// The frame's pose has left already.
    Published,
    /// There is no track, or none that is confirmed and was measured in the last frame.
    NotMeasuredBefore,
    /// Markers contradicted a pose of the direct pass some frames ago.
    Suspended,
    /// No marker was decoded, and there is no prediction.
    NothingKnown,
    /// No marker was decoded, and no view of the target is held.
    NoView,
}

/// A pass over one target.
#[derive(Debug, Clone, PartialEq)]
pub struct Trial {
    /// Which.
    pub pass: Pass,
    /// The place in the plan of the view whose pixels it read.
    pub view_index: Option<u32>,
    /// How much time it had.
    pub budget: TimeBudget,
    /// Whether rough starts and the search were left to the background pass.
    pub is_deferred: bool,
    /// What the track predicted, `camera_from_markers`.
    pub predicted: Option<Isometry3<f64>>,
    /// Whether that track is confirmed.
    pub is_confirmed: bool,
    /// Ids of the markers that were decoded.
    pub decoded: Vec<u32>,
    /// Ids of squares that are probably markers.
    pub doubtful: Vec<u32>,
    /// Poses that the decoded corners give, the cheapest first.
    pub corner_poses: Vec<CornerPose>,
    /// Poses that were compared with the picture, in the order in which they were tried.
    pub hypotheses: Vec<Hypothesis>,
    /// What was decided of them.
    pub decision: Decision,
    /// What became of the pose that was chosen.
    pub outcome: Outcome,
}

impl Trial {
    /// A pass that begins.
    pub fn of(pass: Pass, prior: &TrackPrior, budget: TimeBudget) -> Self {
        Self {
            pass,
            view_index: None,
            budget,
            is_deferred: false,
            predicted: prior.predicted().copied(),
            is_confirmed: prior.confirmed().is_some(),
            decoded: Vec::new(),
            doubtful: Vec::new(),
            corner_poses: Vec::new(),
            hypotheses: Vec::new(),
            decision: Decision::default(),
            outcome: Outcome::Nothing,
        }
    }

    /// Hypotheses with what was decided of each.
    pub fn decided(&self) -> impl Iterator<Item = (&Hypothesis, Verdict)> {
        self.hypotheses.iter().zip(self.decision.reasons.iter().copied())
    }

    /// The pose that was chosen, as a measurement.
    pub fn measurement(&self) -> Option<PoseMeasurement> {
        let markers = self.decoded.len() as u32;
        decide::measurement(&self.decision, &self.hypotheses, &self.corner_poses, markers)
    }
}
