//! What goes into the core and what comes out of it.

use flockeye_contract::{FrameEnd, FrameStamp, Rotation, ViewHeader};

use crate::account::Trial;
use crate::measure::background::Job;
use crate::notices::Notice;
use crate::output::TrackMessage;
use crate::planning::NextPlan;
use crate::record::Record;

/// What happens to fusion.
#[derive(Debug)]
#[expect(clippy::large_enum_variant, reason = "one at a time, on the stack")]
pub enum Event<P> {
    /// A view was cut; `P` holds its pixels.
    View(ViewHeader, P),
    /// A view was searched for markers.
    Searched(Record),
    /// Rectification is done with a frame.
    FrameEnd(FrameEnd),
    /// How the camera has turned since the frame before.
    Rotation(Rotation),
    /// The background pass that was under way is over.
    Background(Box<Trial>),
}

/// What a step led to, to be sent in this order.
#[derive(Debug, Default)]
pub struct Outputs {
    /// Messages of the topic `track`.
    pub tracks: Vec<TrackMessage>,
    /// The plan for the next frame, and the frame that it was made after.
    pub plan: Option<(NextPlan, Option<FrameStamp>)>,
    /// A background pass to be run; its answer comes back as an [`Event`].
    pub job: Option<Job>,
    /// When rectification took up the frame that has ended, nanoseconds of CLOCK_MONOTONIC; `None`
    /// if that is not known or none has.
    pub(crate) taken_ns: Option<i64>,
    /// What an operator should know.
    pub(crate) notices: Vec<Notice>,
    /// Whether nothing was left to do.
    pub is_idle: bool,
}

impl Outputs {
    /// Whether the step did anything. One that did nothing has changed nothing.
    pub fn has_worked(&self) -> bool {
        !self.is_idle || self.job.is_some()
    }

    /// How many messages of the topics `track` and `plan` it led to.
    pub fn messages(&self) -> (usize, usize) {
        (self.tracks.len(), usize::from(self.plan.is_some()))
    }
}
