//! Inputs and outputs of the core.

use flockeye_contract::{FrameEnd, FrameStamp, Rotation, ViewHeader};

use crate::account::Trial;
use crate::measure::background::Job;
use crate::notices::Notice;
use crate::output::TrackMessage;
use crate::planning::NextPlan;
use crate::record::Record;

/// An input of fusion.
#[derive(Debug)]
#[expect(clippy::large_enum_variant, reason = "one at a time, on the stack")]
pub enum Event<P> {
    /// A view was cut; `P` holds its pixels.
    View(ViewHeader, P),
    /// A view was searched for markers.
    Searched(Record),
    /// Rectification has finished a frame.
    FrameEnd(FrameEnd),
    /// Rotation of the camera since the frame before.
    Rotation(Rotation),
    /// The running background pass is over.
    Background(Box<Trial>),
}

/// Output of a step, to be sent in this order.
#[derive(Debug, Default)]
pub struct Outputs {
    /// Messages of the topic `track`.
    pub tracks: Vec<TrackMessage>,
    /// The plan for the next frame, and the frame before it.
    pub plan: Option<(NextPlan, Option<FrameStamp>)>,
    /// A background pass to be run; its answer comes back as an [`Event`].
    pub job: Option<Job>,
    /// Time at which rectification began the frame that has ended, nanoseconds of CLOCK_MONOTONIC;
    /// `None` if that is not known or none has ended.
    pub(crate) taken_ns: Option<i64>,
    /// Notices to the operator.
    pub(crate) notices: Vec<Notice>,
    /// Whether there was no work left.
    pub is_idle: bool,
}

impl Outputs {
    /// Whether the step did anything. A step without work has changed nothing.
    pub fn has_worked(&self) -> bool {
        !self.is_idle || self.job.is_some()
    }

    /// Number of its messages of the topics `track` and `plan`.
    pub fn messages(&self) -> (usize, usize) {
        (self.tracks.len(), usize::from(self.plan.is_some()))
    }
}
