//! All that is known of one target in one frame.

use flockeye_contract::FrameStamp;
use flockeye_fusion::{AccountEntry, Core};
use flockeye_geometry::filter::TrackState;
use nalgebra::{Isometry3, Matrix6};

use super::gathered::Gathered;
use crate::recorded::{Lost, RecordedPixels};

/// All that is known of one target in one frame.
pub struct Known {
    /// The target's number.
    pub target: usize,
    /// The frame.
    pub stamp: FrameStamp,
    /// When it was exposed, seconds since the recording began.
    pub at_s: f64,
    /// What the stages said.
    pub gathered: Gathered,
    /// What the core knew before the frame; `None` where it was not replayed.
    pub before: Option<Before>,
    /// What the core decided, in this order.
    pub decisions: Vec<AccountEntry>,
    /// Whether the replayed core said all that was recorded, up to and with this frame.
    pub replay: Replaying,
    /// What the recording lacks.
    pub lost: Vec<Lost>,
}

/// How the replay went.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Replaying {
    /// The same bytes.
    Same,
    /// Something else, as stated.
    Different(String),
    /// It could not be done, for the stated reason.
    Impossible(String),
}

/// What a track said before a frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Before {
    /// Its state; `None`: there was no track.
    pub state: Option<TrackState>,
    /// `camera_from_markers` at the frame's exposure, with its covariance.
    pub predicted: Option<(Isometry3<f64>, Matrix6<f64>)>,
}

impl Before {
    /// What `core` knows now of a target for a frame that it has not heard of.
    fn of(core: &Core<RecordedPixels>, target: usize, stamp: &FrameStamp) -> Self {
        let tracker = core.tracker();
        let predicted = tracker.prediction(target, stamp.exposure_s());
        Self {
            state: tracker.targets()[target].state(),
            predicted: predicted.map(|found| (found.camera_from_markers, found.pose_covariance())),
        }
    }
}
