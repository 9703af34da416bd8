//! What goes into the core of rectification, and what comes out.

use flockeye_contract::{
    DetectionHeader, FrameEnd, FrameHeader, FrameOrder, PlanHeader, PlannedView, ViewHeader,
};
use flockeye_imaging::proposals::Proposal;
use flockeye_imaging::sphere::Cut;

use crate::proposals::ProposalSearch;

/// What happens to rectification.
#[expect(missing_docs, reason = "the variants say what the fields are")]
#[derive(Debug)]
pub enum Event<F> {
    /// A frame has come; `F` owns its pixels.
    Frame(FrameHeader, F),
    /// A plan has come.
    Plan(PlanHeader, Vec<PlannedView>),
    /// A worker has searched a view.
    Answer(DetectionHeader),
    /// Places that look like a body were searched in a frame.
    Looked { frame: FrameOrder, found: Vec<Proposal>, took_ns: i64 },
    /// A view was cut and published.
    Published { header: ViewHeader, took_ns: i64 },
    /// The last action on a frame was impossible. No further view of it is cut.
    Failed(FrameOrder),
}

/// What is to be done.
#[derive(Debug, Clone, PartialEq)]
#[expect(missing_docs, reason = "the variants say what the fields are")]
#[expect(clippy::large_enum_variant, reason = "one at a time, on the stack")]
pub enum Action {
    /// Work on a frame begins. The back end may make these cuts ahead.
    TakeUp {
        frame: FrameOrder,
        /// The views that will probably be cut.
        likely: Vec<Cut>,
    },
    /// Search a frame for places that look like a body.
    Look { frame: FrameOrder, search: ProposalSearch },
    /// Cut a view and publish it.
    Cut(CutOrder),
    /// Publish the end of a frame.
    End(FrameEnd),
    /// Nothing, until an event comes, or by then, nanoseconds.
    Wait(Option<i64>),
}

/// A view to be cut.
#[derive(Debug, Clone, PartialEq)]
pub struct CutOrder {
    /// The header of the view's message, complete except for the time of publication.
    pub header: ViewHeader,
    /// The cut.
    pub cut: Cut,
    /// Cuts that the back end may make together with this one. They were never announced before.
    pub ahead: Vec<Cut>,
}

impl CutOrder {
    /// The frame of the view.
    pub fn frame(&self) -> FrameOrder {
        self.header.stamp.order()
    }
}
