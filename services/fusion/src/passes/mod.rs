//! Measurement passes: the ways in which a frame can tell where a target is.
//!
//! | pass | starts from | runs |
//! | --- | --- | --- |
//! | [`direct`] | the track's prediction alone | when a region of interest has been cut |
//! | [`corners`] | decoded markers, and the prediction | when a view has been searched, and when the frame is complete |
//! | [`background`] | rough starts, and a search round the prediction | beside the others, because it takes several times as long |
//! | place ([`Tracker::place_pass`](crate::tracker::Tracker::place_pass)) | a proposal, in any attitude | when a single image is complete |

pub mod background;
pub mod corners;
pub mod direct;
pub mod inputs;

use std::collections::BTreeMap;

use flockeye_contract::ViewHeader;
use flockeye_geometry::search::Purpose;

use crate::frame_assembly::Record;
use crate::hypothesis::BestView;

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
            Purpose::Gaze(target) => Some(target),
            Purpose::Partition(_) | Purpose::HighResolution(_) | Purpose::Proposal => None,
        }
    }
}
