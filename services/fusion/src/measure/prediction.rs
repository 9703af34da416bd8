//! The direct pass: confirmed targets aligned from their predictions alone, before their regions of
//! interest are searched for markers.
//!
//! It takes a fraction of the time of a search, so a tracked target's pose leaves a few
//! milliseconds after the exposure. It only accepts poses that are likely by themselves; all others
//! wait for their markers.

use flockeye_imaging::align::{AlignError, Alignment};
use nalgebra::Isometry3;

use crate::hypothesis::{Aligner, BestView, Start, turn_log};
use crate::measurement::Measurement;
use crate::parallel;

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

/// Aligns each candidate from its prediction, on up to `threads` threads.
pub fn align(
    aligner: &Aligner,
    candidates: &[Candidate<'_>],
    threads: usize,
) -> Vec<Result<Alignment, AlignError>> {
    parallel::map(
        candidates,
        threads,
        |Candidate { region: Region { target, view }, predicted }| {
            aligner.try_align(*target, &view.picture, &Start::Fine(*predicted))
        },
    )
}

/// The measurement that an alignment gives without any marker, if it is precise, and likely by
/// itself and by the prediction.
pub fn accepted(found: &Alignment, predicted: &Isometry3<f64>) -> Option<Measurement> {
    let is_accepted = found.is_precise
        && found.is_accepted()
        && found.is_accepted_with_track_prior(turn_log(found, predicted));
    is_accepted.then(|| Measurement::aligned(found, 0))
}
