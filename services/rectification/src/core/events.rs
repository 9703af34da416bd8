//! Events and actions of the core of rectification.

use flockeye_contract::{
    DetectionHeader, FrameEnd, FrameHeader, FrameOrder, PlanHeader, PlannedView, ViewHeader,
};
use flockeye_imaging::proposals::Proposal;
use flockeye_imaging::sphere::Cut;

use crate::proposals::ProposalSearch;

/// An input of the core.
#[expect(missing_docs, reason = "the variants say what the fields are")]
#[derive(Debug)]
pub enum Event<F> {
    /// A frame was received; `F` owns its pixels.
    Frame(FrameHeader, F),
    /// A plan was received.
    Plan(PlanHeader, Vec<PlannedView>),
    /// A worker has searched a view.
    Answer(DetectionHeader),
    /// The proposal search in a frame is done.
    Looked { frame: FrameOrder, found: Vec<Proposal>, took_ns: i64 },
    /// A view was cut and published.
    Published { header: ViewHeader, took_ns: i64 },
    /// The last action on a frame has failed. No further view of it is cut.
    Failed(FrameOrder),
}

/// An action for the shell.
#[derive(Debug, Clone, PartialEq)]
#[expect(missing_docs, reason = "the variants say what the fields are")]
#[expect(clippy::large_enum_variant, reason = "one at a time, on the stack")]
pub enum Action {
    /// Begin the work on a frame. The back end may make these cuts ahead.
    TakeUp {
        frame: FrameOrder,
        /// The views that will probably be cut.
        likely: Vec<Cut>,
    },
    /// Search a frame for proposals.
    Look { frame: FrameOrder, search: ProposalSearch },
    /// Cut a view and publish it.
    Cut(CutOrder),
    /// Publish the end of a frame.
    End(FrameEnd),
    /// Wait for an event, or until this time, nanoseconds.
    Wait(Option<i64>),
}

/// A view to be cut.
#[derive(Debug, Clone, PartialEq)]
pub struct CutOrder {
    /// The header of the view's message, complete except for the time of publication.
    pub header: ViewHeader,
    /// The cut.
    pub cut: Cut,
    /// Cuts that the back end may make together with this one; none was announced before.
    pub ahead: Vec<Cut>,
}

impl CutOrder {
    /// The frame of the view.
    pub fn frame(&self) -> FrameOrder {
        self.header.stamp.order()
    }
}
