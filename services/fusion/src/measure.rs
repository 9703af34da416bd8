//! The measurement pass: the ways in which a frame can measure a target.
//!
//! A pass collects a frame's data on a target ([`inputs`]), compares the body with the picture from
//! some starts, and returns a trial with a decision. The tracker updates the target's track with
//! the chosen pose. There are five kinds of it:
//!
//! | kind | starts from | requires | runs |
//! | --- | --- | --- | --- |
//! | direct | the prediction alone | a confirmed track | when a region of interest has been cut |
//! | region | markers, the prediction | two markers, where no picture decides | when that region has been searched |
//! | complete | those of all views | two markers, or one with a confirmed track | when the frame is complete |
//! | background | the markers of a track that is not confirmed, the rough prediction | a track, and a picture | beside the others, so that no other pose waits |
//! | place | nothing, in any attitude | no track | when a single image is complete |

pub(crate) mod background;
pub(crate) mod inputs;

use std::collections::{BTreeMap, BTreeSet};

use flockeye_contract::{DetectedMarker, FrameOrder, ViewHeader};
use flockeye_geometry::body::Body;
use flockeye_geometry::search::Purpose;

use crate::account::Pass;
use crate::aligner::BestView;
use crate::decide::MARKERS_WITHOUT_TRACK;
use crate::hypothesis::StartSource;
use crate::record::Record;

/// Differences between the kinds: the rows of the table above.
impl Pass {
    /// Starts of the alignment, in this order: corners first, because they need no track. Rough
    /// starts cost most.
    pub(crate) fn starts(self) -> &'static [StartSource] {
        use StartSource::{Corners, Place, Prediction, RoughPrediction};
        match self {
            Self::Direct => &[Prediction],
            Self::Region | Self::Complete => &[Corners, Prediction, RoughPrediction],
            Self::Background => &[Corners, RoughPrediction],
            Self::Place => &[Place],
        }
    }

    /// Least number of fitting decoded markers with a confirmed track, where nothing was aligned.
    /// One is enough if no more can arrive.
    pub(crate) fn min_markers(self) -> usize {
        if self == Self::Complete { 1 } else { MARKERS_WITHOUT_TRACK }
    }
}

/// Place of a frame in time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct FrameTime {
    /// Its place among all frames.
    pub(crate) order: FrameOrder,
    /// Its exposure, seconds.
    pub(crate) at_s: f64,
}

/// The best view of each target in a frame, by the target's number.
pub(crate) type BestViews<'p> = BTreeMap<usize, BestView<'p>>;

/// A record with the purpose of its view and, if it has arrived, the view itself.
#[derive(Debug, Clone, Copy)]
pub(crate) struct AnsweredView<'s> {
    /// The detections.
    pub(crate) record: &'s Record,
    /// Purpose of the view.
    pub(crate) purpose: Option<Purpose>,
    pub(crate) view: Option<&'s ViewHeader>,
}

impl AnsweredView<'_> {
    /// The target whose region of interest the view is.
    pub(crate) fn region_of(&self) -> Option<usize> {
        match self.purpose? {
            Purpose::Roi(target) => Some(target),
            Purpose::Partition(_) | Purpose::HighResolution(_) | Purpose::Proposal => None,
        }
    }
}

/// Number of different decoded markers of a body.
pub(crate) fn distinct_decoded<'m>(
    markers: impl Iterator<Item = &'m DetectedMarker>,
    body: &Body,
) -> u32 {
    let ids: BTreeSet<u32> = markers.map(|marker| marker.id).collect();
    ids.iter().filter(|&&id| body.marker(id).is_some()).count() as u32
}
