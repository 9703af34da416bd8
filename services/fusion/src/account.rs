//! Account of the decisions about one body in each frame, with their reasons, as plain data.
//!
//! Each pass returns a [`Trial`] of its target: the tried poses, the decision, and its outcome. The
//! tracker keeps the trials of one target for `flockeye explain`; they have no effect on decisions.

use nalgebra::Isometry3;

use crate::decide::outcome::Outcome;
use crate::decide::{self, Decision, Verdict};
use crate::hypothesis::{CornerPose, Hypothesis};
use crate::measurement::PoseMeasurement;
use crate::policy::TimeBudget;
use crate::track_prior::TrackPrior;

/// An event of the target in a frame.
#[derive(Debug, Clone, PartialEq)]
#[allow(clippy::large_enum_variant, reason = "a few for each frame that somebody asks about")]
pub enum AccountEntry {
    /// A pass was due, but did not run.
    NotRun(Pass, NotRun),
    /// A pass ran.
    Ran(Trial),
    /// Decoded markers contradict the pose of the direct pass, so its target waits for its markers
    /// for a while.
    Contradicted,
    /// The frame is complete, and a pose that only corrects the track was used.
    TakenImprecise(Outcome),
}

/// A measurement pass.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Pass {
    /// Starts from the prediction alone.
    Direct,
    /// Starts from markers and the prediction, after the search of the region of interest.
    Region,
    /// The corner pass over the whole complete frame.
    Complete,
    /// Alignment from rough starts, beside the other passes.
    Background,
    /// Searches in any attitude, at a place that looks like a body.
    Place,
}

/// Reason why a pass did not run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NotRun {
    /// The frame's pose was already published.
    Published,
    /// There is no track, or none that is confirmed.
    NotConfirmed,
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
    /// Kind of the pass.
    pub pass: Pass,
    /// Place in the plan of the view that it read.
    pub view_index: Option<u32>,
    /// Its time budget.
    pub budget: TimeBudget,
    /// Whether rough starts were left to the background pass.
    pub is_deferred: bool,
    /// The track's prediction, `camera_from_markers`.
    pub predicted: Option<Isometry3<f64>>,
    /// Whether that track is confirmed.
    pub is_confirmed: bool,
    /// Ids of the markers that were decoded.
    pub decoded: Vec<u32>,
    /// Poses from the decoded corners, the cheapest first.
    pub corner_poses: Vec<CornerPose>,
    /// Poses that were compared with the picture, in the order in which they were tried.
    pub hypotheses: Vec<Hypothesis>,
    /// The decision about them.
    pub decision: Decision,
    /// Outcome of the chosen pose.
    pub outcome: Outcome,
}

impl Trial {
    /// A pass at its start.
    pub fn of(pass: Pass, prior: &TrackPrior, budget: TimeBudget) -> Self {
        Self {
            pass,
            view_index: None,
            budget,
            is_deferred: false,
            predicted: prior.predicted().map(|predicted| predicted.camera_from_markers),
            is_confirmed: prior.confirmed().is_some(),
            decoded: Vec::new(),
            corner_poses: Vec::new(),
            hypotheses: Vec::new(),
            decision: Decision::default(),
            outcome: Outcome::Nothing,
        }
    }

    /// Hypotheses with the verdict on each.
    pub fn decided(&self) -> impl Iterator<Item = (&Hypothesis, Verdict)> {
        self.hypotheses.iter().zip(self.decision.reasons.iter().copied())
    }

    /// The pose that was chosen, as a measurement.
    pub fn measurement(&self) -> Option<PoseMeasurement> {
        let markers = self.decoded.len() as u32;
        decide::measurement(&self.decision, &self.hypotheses, &self.corner_poses, markers)
    }
}
