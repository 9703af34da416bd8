//! The known facts about one target in one frame.

use flockeye_contract::FrameStamp;
use flockeye_fusion::{AccountEntry, Core, Trial};
use flockeye_geometry::filter::TrackState;
use nalgebra::{Isometry3, Matrix6};

use super::gathered::StageMessages;
use crate::recorded::{LostMessages, RecordedPixels};

/// The known facts about one target in one frame.
pub(super) struct FrameKnowledge {
    /// The target's number.
    pub target: usize,
    /// The frame.
    pub stamp: FrameStamp,
    /// Exposure of the frame, seconds since the recording began.
    pub at_s: f64,
    /// Messages of the stages.
    pub gathered: StageMessages,
    /// The track before the frame; `None` if the core was not replayed.
    pub before: Option<TrackBefore>,
    /// The decisions of the core, in order.
    pub decisions: Vec<AccountEntry>,
    /// Comparison of replayed and recorded messages, up to and including this frame.
    pub replay: ReplayOutcome,
    /// Messages that the recording lacks.
    pub lost: LostMessages,
}

impl FrameKnowledge {
    /// The passes that ran.
    pub(super) fn trials(&self) -> impl Iterator<Item = &Trial> {
        self.decisions.iter().filter_map(|decision| match decision {
            AccountEntry::Ran(trial) => Some(trial),
            _ => None,
        })
    }
}

/// The result of a replay.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum ReplayOutcome {
    /// Fusion gave the same bytes.
    Same,
    /// Fusion gave other bytes: the first difference.
    Different(String),
    /// Fusion could not be replayed, for this reason.
    Impossible(String),
}

/// The track of a target before a frame.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct TrackBefore {
    /// State of the track; `None`: there was no track.
    pub state: Option<TrackState>,
    /// `camera_from_markers` at the frame's exposure, with its covariance.
    pub predicted: Option<(Isometry3<f64>, Matrix6<f64>)>,
}

impl TrackBefore {
    /// Reads the track of a target from `core`, before the first message about a frame.
    pub(super) fn of(core: &Core<RecordedPixels>, target: usize, stamp: &FrameStamp) -> Self {
        let tracker = core.tracker();
        let predicted = tracker.prediction(target, stamp.exposure_s());
        Self {
            state: tracker.targets()[target].state(),
            predicted: predicted.map(|found| (found.camera_from_markers, found.pose_covariance())),
        }
    }
}
