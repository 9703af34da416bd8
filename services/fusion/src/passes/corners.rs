//! The corner pass: targets measured from decoded markers and their best view.
//!
//! It runs as soon as the region of interest of a target has been searched, and once more for all that
//! is left when the frame is complete.

use std::collections::BTreeSet;

use flockeye_contract::DetectedMarker;
use flockeye_geometry::body::Body;
use flockeye_geometry::search::StopRule;

use super::inputs::{Inputs, MARKERS_WITHOUT_TRACK};
use crate::account::{Pass, Trial};
use crate::frame_assembly::{Frame, Record};
use crate::hypothesis::Aligner;
use crate::measurement::Measurement;
use crate::parallel;

/// When a corner pass runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Moment {
    /// A region of interest has been searched, while the rest of the frame still is.
    RegionSearched,
    /// All of the frame has been searched.
    FrameComplete,
}

impl Moment {
    /// Its pass, for an account of it.
    pub fn pass(self) -> Pass {
        match self {
            Self::RegionSearched => Pass::Region,
            Self::FrameComplete => Pass::Complete,
        }
    }

    /// Decoded markers that must agree where there is a confirmed track but nothing was aligned. One is
    /// enough only when no more can come.
    pub fn min_markers(self) -> usize {
        match self {
            Self::RegionSearched => MARKERS_WITHOUT_TRACK,
            Self::FrameComplete => 1,
        }
    }
}

/// Measures each target by its inputs, on up to `threads` threads, and says how if its `account` is kept.
pub fn measure(
    aligner: &Aligner,
    inputs: &[Inputs<'_>],
    threads: usize,
    account: impl Fn(&Inputs<'_>) -> Option<Trial> + Sync,
) -> Vec<(Option<Measurement>, Option<Trial>)> {
    parallel::map(inputs, threads, |inputs| {
        let mut trial = account(inputs);
        (inputs.measure(aligner, trial.as_mut()), trial)
    })
}

/// A frame's records in plan order. With the rule `first_hit` only those up to the first hit count: how
/// many workers had searched beyond it depends on time.
pub fn records_that_count(frame: &Frame, stop_rule: StopRule) -> Vec<&Record> {
    let mut counted = Vec::new();
    for record in frame.records.values() {
        counted.push(record);
        if stop_rule == StopRule::FirstHit && record.header.hits > 0 {
            break;
        }
    }
    counted
}

/// How many different markers of a body were decoded.
pub fn distinct_decoded<'m>(markers: impl Iterator<Item = &'m DetectedMarker>, body: &Body) -> u32 {
    let decoded = markers.filter(|marker| marker.is_decoded());
    let ids: BTreeSet<u32> = decoded.map(|marker| marker.id).collect();
    ids.iter().filter(|&&id| body.marker(id).is_some()).count() as u32
}
