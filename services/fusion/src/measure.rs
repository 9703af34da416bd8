//! The measurement pass: the ways in which a frame can tell where a target is.
//!
//! A pass collects what a frame offers of a target ([`inputs`]), compares the body with the picture
//! from some starts, and gives a trial with a decision. The tracker takes the chosen pose into the
//! target's track. Five kinds of it differ by a [`Row`] of one table:
//!
//! | kind | starts from | asks for | runs |
//! | --- | --- | --- | --- |
//! | direct | the prediction alone | a track measured in the frame before | when a region of interest has been cut |
//! | region | markers, squares like them, the prediction | two markers, where no picture decides | when that region has been searched |
//! | complete | those of all views | two markers, or one with a confirmed track | when the frame is complete |
//! | background | markers without a confirmed track, squares like them, the rough prediction, a search round it | a picture | beside the others: it takes several times as long |
//! | place | nothing, in any attitude | no track | when a single image is complete |

pub mod background;
pub mod comparison;
pub mod inputs;

use std::collections::{BTreeMap, BTreeSet};

use flockeye_contract::{DetectedMarker, ViewHeader};
use flockeye_geometry::body::Body;
use flockeye_geometry::search::Purpose;

use crate::account::Pass;
use crate::aligner::BestView;
use crate::decide::MARKERS_WITHOUT_TRACK;
use crate::hypothesis::Source;
use crate::record::Record;
use crate::target::Target;

/// What differs between the kinds of the measurement pass.
#[derive(Debug, PartialEq, Eq)]
pub struct Row {
    /// The kind.
    pub pass: Pass,
    /// What alignment starts from, in this order.
    pub starts: &'static [Source],
    /// Which track a target must have.
    pub prior: RequiredPrior,
    /// Whether no more markers can come. Then one is enough where there is a confirmed track, and
    /// the pass itself may search round the prediction.
    pub is_last: bool,
    /// Whether a pose must be certain by the picture and the prediction. Others wait for markers.
    pub is_certain: bool,
}

/// Which track a target must have.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RequiredPrior {
    /// A target that is confirmed and was measured in the frame before.
    Measured,
    /// Any, or none.
    Any,
    /// None.
    Untracked,
}

impl RequiredPrior {
    /// Whether a target has such a track.
    pub fn allows(self, target: &Target) -> bool {
        match self {
            Self::Measured => target.is_measured(),
            Self::Any => true,
            Self::Untracked => !target.is_tracked(),
        }
    }
}

/// Corners first, because they need no track. Rough starts cost most.
const MARKERS_AND_PREDICTION: &[Source] =
    &[Source::Corners, Source::DoubtfulSquares, Source::Prediction, Source::RoughPrediction];

/// A pass over a region of interest. The others say how they differ.
const REGION: Row = Row {
    pass: Pass::Region,
    starts: MARKERS_AND_PREDICTION,
    prior: RequiredPrior::Any,
    is_last: false,
    is_certain: false,
};

/// The table, in the order of [`Pass`].
static ROWS: [Row; 5] = [
    Row {
        pass: Pass::Direct,
        starts: &[Source::Prediction],
        prior: RequiredPrior::Measured,
        is_certain: true,
        ..REGION
    },
    REGION,
    Row { pass: Pass::Complete, is_last: true, ..REGION },
    Row {
        pass: Pass::Background,
        starts: &[Source::Corners, Source::DoubtfulSquares, Source::RoughPrediction],
        ..REGION
    },
    Row { pass: Pass::Place, starts: &[Source::Place], prior: RequiredPrior::Untracked, ..REGION },
];

impl Row {
    /// The row of a kind.
    pub fn of(pass: Pass) -> &'static Self {
        &ROWS[pass as usize]
    }

    /// Decoded markers that must agree where there is a confirmed track but nothing was aligned.
    pub fn min_markers(&self) -> usize {
        if self.is_last { 1 } else { MARKERS_WITHOUT_TRACK }
    }
}

/// A region of interest that has been cut.
#[derive(Debug, Clone, Copy)]
pub struct Region<'v> {
    /// The target's number.
    pub target: usize,
    /// The view.
    pub view: BestView<'v>,
}

/// The best view of each target in a frame, by the target's number.
pub type BestViews<'p> = BTreeMap<usize, BestView<'p>>;

/// A record with the purpose of its view and, where it has come, the view itself.
#[derive(Debug, Clone, Copy)]
pub struct AnsweredView<'s> {
    /// What was found.
    pub record: &'s Record,
    /// Why the view was cut.
    pub purpose: Option<Purpose>,
    /// The view.
    pub view: Option<&'s ViewHeader>,
}

impl AnsweredView<'_> {
    /// The target whose region of interest the view is.
    pub fn region_of(&self) -> Option<usize> {
        match self.purpose? {
            Purpose::Roi(target) => Some(target),
            Purpose::Partition(_) | Purpose::HighResolution(_) | Purpose::Proposal => None,
        }
    }
}

/// How many different markers of a body were decoded.
pub fn distinct_decoded<'m>(markers: impl Iterator<Item = &'m DetectedMarker>, body: &Body) -> u32 {
    let decoded = markers.filter(|marker| marker.is_decoded());
    let ids: BTreeSet<u32> = decoded.map(|marker| marker.id).collect();
    ids.iter().filter(|&&id| body.marker(id).is_some()).count() as u32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_kind_has_its_row() {
        for row in &ROWS {
            assert_eq!(Row::of(row.pass), row);
        }
    }
}
