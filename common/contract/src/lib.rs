//! The messages that cross a process border in Flockeye.
//!
//! There are two borders:
//! - **shared memory**, between the stages on one machine: [`Topic`]s of `#[repr(C)]` headers and
//!   items ([`FrameHeader`], [`PacketHeader`], [`ImuHeader`], [`Rotation`], [`PlanHeader`],
//!   [`ViewHeader`], [`DetectionHeader`], [`FrameEnd`], [`TrackHeader`], [`JournalHeader`],
//!   [`Health`], [`TruthHeader`], [`HandOver`], [`Complaint`]);
//! - **the network**, between drones: the JSON of [`wire`].
//!
//! ```
//! use flockeye_contract::{ContractError, Pose, Topic, Track, TrackHeader, TrackState, Tracks};
//!
//! // A neighbour 1.5 m ahead of the observer, as fusion publishes it.
//! let track = Track {
//!     name: "kite".into(),
//!     observer_from_target: Pose { position: [1.5, 0.0, 0.0], ..Pose::default() },
//!     state: TrackState::Confirmed.code(),
//!     ..Track::default()
//! };
//! assert_eq!(Tracks::NAME, "flockeye/track");
//! Tracks::check(&TrackHeader::default(), &[track])?;
//! // What cannot be true is refused before anybody reads it.
//! let nowhere = Pose { position: [f64::NAN; 3], ..Pose::default() };
//! let track = Track { observer_from_target: nowhere, ..track };
//! let refused = Tracks::check(&TrackHeader::default(), &[track]);
//! assert_eq!(refused, Err(ContractError::NotFinite { what: "position" }));
//! # Ok::<(), ContractError>(())
//! ```
//!
//! This crate has the data and their validation ([`Topic::check`]); the runtime transports them.
//! `docs/CONTRACT.md` describes the same bytes for stages in other languages. The tests of `layout`
//! and `documents` compare every offset, code and version with it. Clients in other languages are
//! generated from [`description`].

mod codes;
mod complaint;
pub mod description;
mod detection;
#[cfg(test)]
mod documents;
mod error;
mod frame;
mod handover;
mod health;
mod imu;
mod journal;
#[cfg(test)]
mod layout;
mod odometry;
mod packet;
mod peer;
mod plan;
mod rotation;
mod stage;
mod text;
mod topic;
mod track;
mod truth;
mod view;
pub mod wire;

pub use codes::{
    ComplaintKind, HandOverState, JournalKind, MeasuredBy, PixelFormat, Projection, Range,
    RotationSource, Search, SearchMode, StageState, StopReason, StopRule, SwarmWay, TrackState,
    Transfer, VideoCodec, ViewKind,
};
pub use complaint::Complaint;
pub use detection::{DetectedMarker, DetectionHeader, MAX_DETECTED_MARKERS};
pub use error::ContractError;
pub use frame::{FrameHeader, FrameOrder, FrameStamp};
pub use handover::{HandOver, MessageSender};
pub use health::Health;
pub use imu::{ImuHeader, ImuSample, MAX_IMU_RATE, MAX_IMU_SAMPLES};
pub use journal::{JournalEntry, JournalHeader, MAX_JOURNAL_ENTRIES};
pub use odometry::OdometrySample;
pub use packet::{MAX_PACKET_BYTES, PacketHeader};
pub use peer::{PeerHeader, PeerSighting, SwarmHeader, SwarmPose};
pub use plan::{MAX_PLANNED_VIEWS, MAX_VIEW_PX, PlanHeader, PlannedView};
pub use rotation::Rotation;
pub use stage::StageName;
pub use text::Text;
pub use topic::{
    CONTRACT_VERSION, Complaints, Detections, FrameEnds, Frames, HandOvers, Healths, Imus,
    Journals, Odometries, Packets, Peers, Plans, Rotations, Swarms, TOPICS, Topic, TopicId,
    TopicInfo, TopicVisitor, Tracks, Truths, VERSION_ATTRIBUTE, Views, visit_topics,
};
pub use track::{AMBIGUOUS, FrameEnd, Pose, StageLatency, Track, TrackHeader};
pub use truth::{BodyTruth, TruthHeader};
pub use view::ViewHeader;

/// "No target", "no partition", "any worker": the value of an index field that points nowhere.
pub const NONE: u32 = u32::MAX;
