//! The direct pass: confirmed targets aligned from their predictions alone, before their regions of
//! interest are searched for markers.
//!
//! It takes a fraction of the time of a search, so a tracked target's pose leaves a few
//! milliseconds after the exposure. It only accepts poses that are likely by themselves; all others
//! wait for their markers.

use flockeye_imaging::align::{AlignError, Alignment};
use nalgebra::Isometry3;

use crate::account::{Pass, Trial};
use crate::aligner::{Aligner, BestView, Start};
use crate::decide;
use crate::hypothesis::{Hypothesis, Source};
use crate::parallel;
use crate::policy::TimeBudget;
use crate::track_prior::TrackPrior;

/// A region of interest that has been cut.
#[derive(Debug, Clone, Copy)]
pub struct Region<'v> {
    /// The target's number.
    pub target: usize,
    /// The view.
    pub view: BestView<'v>,
}

/// A region of interest with the prediction that alignment starts from.
#[derive(Debug, Clone, Copy)]
pub struct Candidate<'v> {
    /// The region.
    pub region: Region<'v>,
    /// `camera_from_markers` of a confirmed track.
    pub predicted: Isometry3<f64>,
}

/// An alignment from a prediction alone that was not accepted, whether it is the body or not.
#[derive(Debug, Clone)]
pub struct RejectedAlignment {
    /// The prediction, `camera_from_markers`.
    pub predicted: Isometry3<f64>,
    /// The view's place in the plan.
    pub view_index: u32,
    /// What it led to.
    pub found: Result<Box<Alignment>, AlignError>,
}

/// Aligns each candidate from its prediction, on up to `threads` threads, and decides about it.
pub fn measure(aligner: &Aligner, candidates: &[Candidate<'_>], threads: usize) -> Vec<Trial> {
    parallel::map(
        candidates,
        threads,
        |Candidate { region: Region { target, view }, predicted }| {
            let found = aligner.try_align(*target, &view.picture, &Start::Fine(*predicted));
            let turn_log = found.as_ref().ok().map(|found| decide::turn_log(found, predicted));
            let hypothesis = Hypothesis { turn_log, ..Hypothesis::of(Source::Prediction, found) };
            Trial {
                view_index: Some(view.view_index),
                is_confirmed: true,
                predicted: Some(*predicted),
                decision: decide::of_direct_pass(&hypothesis),
                hypotheses: vec![hypothesis],
                ..Trial::of(Pass::Direct, &TrackPrior::Untracked, TimeBudget::OneFrame)
            }
        },
    )
}
