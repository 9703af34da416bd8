//! What crosses a process border in Flockeye.
//!
//! Two borders, two vocabularies:
//! - **shared memory**, between the stages on one machine: [`Topic`]s of `#[repr(C)]` headers and
//!   items ([`FrameHeader`], [`PlanHeader`], [`ViewHeader`], [`DetectionHeader`], [`FrameEnd`],
//!   [`TrackHeader`], [`Health`], [`TruthHeader`]);
//! - **the network**, between drones: the JSON of [`wire`].
//!
//! Everything here is data and the check that it is what it says ([`Topic::check`]); how it is
//! transported is the runtime's business. `docs/CONTRACT.md` describes the same bytes for writers
//! in other languages; the tests of `layout` and `documents` pin every offset, code and version in it.

mod codes;
mod detection;
#[cfg(test)]
mod documents;
mod frame;
mod health;
#[cfg(test)]
mod layout;
mod plan;
mod text;
mod topic;
mod track;
mod truth;
mod view;
pub mod wire;

pub use codes::{
    MeasuredBy, PixelFormat, Projection, Range, Search, SearchMode, StageState, StopReason,
    StopRule, TrackState, Transfer, UnknownCode, ViewKind,
};
pub use detection::{DetectedMarker, DetectionHeader, MAX_DETECTED_MARKERS};
pub use frame::{FrameHeader, FrameStamp};
pub use health::Health;
pub use plan::{MAX_PLANNED_VIEWS, MAX_VIEW_PX, PlanHeader, PlannedView};
pub use text::Text;
pub use topic::{
    ALL_TOPICS, CONTRACT_VERSION, ContractError, Detections, FrameEnds, Frames, Healths, Plans,
    Topic, Tracks, Truths, VERSION_ATTRIBUTE, Views,
};
pub use track::{FrameEnd, Pose, StageLatency, Track, TrackHeader};
pub use truth::{BodyTruth, TruthHeader};
pub use view::ViewHeader;

/// "No target", "no partition", "any worker": the value of an index field that points nowhere.
pub const NONE: u32 = u32::MAX;
