//! The messages to the page. docs/RECORDING.md describes them; a test compares it with this file.
//!
//! Numbers are of single precision: a page draws with them, and nobody measures by them.

use flockeye_contract::FrameStamp;
use serde::Serialize;
use tungstenite::Message;

use crate::outbox::OutboxKind;

/// Version of these messages. A page of another version asks to be loaded again.
pub const PROTOCOL: u32 = 1;

/// A message as text.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum TextMessage<'m> {
    /// The first message, and again where a pipeline has started anew.
    Hello(&'m Hello),
    Frame(&'m FrameMessage),
    /// What the stages report.
    Stages {
        /// One for each process.
        stages: &'m [ProcessReport],
    },
    Swarm {
        drones: &'m [DroneSummary],
        /// Sightings: which drone sees which.
        sightings: &'m [SightingSummary],
    },
    /// What is wrong with the view itself.
    Status {
        running: bool,
        /// Why there are no pictures, for people; empty where there are.
        trouble: &'m str,
    },
    /// Which frame of a recording is shown now. What belongs to it came before.
    Position {
        /// The frame; absent where the recording has none.
        key: Option<&'m str>,
        /// The time that is shown, seconds from the recording's beginning.
        at_s: f64,
        /// Seconds of the recording in each second; 0: paused.
        speed: f64,
        /// The frame whose picture is the nearest before, if there is one.
        picture: Option<&'m str>,
        /// How many of the page's commands have been done.
        answers: u64,
    },
    /// An overview of a whole recording.
    Overview(&'m Overview),
}

impl TextMessage<'_> {
    /// How it waits for a page that follows a running pipeline.
    pub fn kind(&self) -> OutboxKind {
        match self {
            Self::Hello(_) => OutboxKind::Hello,
            Self::Frame(_) => OutboxKind::Frame,
            Self::Stages { .. } => OutboxKind::Stages,
            Self::Swarm { .. } => OutboxKind::Swarm,
            Self::Status { .. } => OutboxKind::Status,
            Self::Position { .. } => OutboxKind::Answer,
            Self::Overview(_) => OutboxKind::Overview,
        }
    }
}

/// The head of a binary message; a JPEG follows it.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum BinaryHead {
    /// A frame's picture, equirectangular.
    Picture {
        key: String,
        /// Sides, pixels.
        size: [u32; 2],
    },
    /// A neighbour's close-up: panels side by side.
    Closeup(CloseupHead),
}

/// What a page must know once.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Hello {
    /// [`PROTOCOL`].
    pub protocol: u32,
    /// Name of the pipeline.
    pub instance: String,
    /// `latest` or `lossless`.
    pub flow: &'static str,
    /// Whether the world is simulated.
    pub simulated: bool,
    /// Name of this drone.
    pub observer: String,
    /// Sides of the camera's frames, pixels.
    pub camera_px: [u32; 2],
    /// The camera's mount on this drone.
    pub observer_from_camera: PagePose,
    /// Tiles of the sphere.
    pub partitions: Vec<ViewSquare>,
    /// High-resolution tiles.
    pub high_resolution: Vec<ViewSquare>,
    /// The neighbours' bodies, by their `target` numbers.
    pub bodies: Vec<PageBody>,
    /// Names of the stages that run.
    pub stages: Vec<&'static str>,
    /// Pictures a second, at most.
    pub rate: f32,
    /// The recording that is shown; absent where it is a running pipeline.
    pub recording: Option<RecordingSummary>,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RecordingSummary {
    pub file: String,
    /// When it begins, UTC seconds since 1970.
    pub began_s: f64,
    /// How long it is, seconds.
    pub duration_s: f64,
    /// Whether the recording has pictures of frames.
    pub pictures: bool,
}

/// A pose `a_from_b`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PagePose {
    /// Metres.
    pub p: [f32; 3],
    /// Unit quaternion x, y, z, w.
    pub q: [f32; 4],
}

/// A square pinhole view.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ViewSquare {
    /// `camera_from_view`: unit quaternion x, y, z, w.
    pub q: [f32; 4],
    /// Half of its side, at distance 1 along its axis.
    pub half: f32,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PageBody {
    pub name: String,
    /// Pose of the markers on their drone.
    pub target_from_markers: PagePose,
    /// Outlines of its flat sides in the markers' frame, metres.
    pub facets: Vec<Vec<[f32; 3]>>,
    pub markers: Vec<PageMarker>,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PageMarker {
    /// Its number in the dictionary.
    pub id: u32,
    /// Corners of the black square in the markers' frame, metres.
    pub corners: [[f32; 3]; 4],
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FrameMessage {
    /// Names the frame: see [`key`].
    pub key: String,
    /// Its number in its epoch.
    pub sequence: u64,
    /// Seconds on the clock of the exposures.
    pub exposure_s: f64,
    /// Age of the exposure when this was sent, milliseconds; absent in a lossless run.
    pub age_ms: Option<f32>,
    /// Frames of the source that never ended, since this view joined.
    pub skipped: u64,
    /// Partitions that were searched in it.
    pub partitions: Vec<u32>,
    /// High-resolution tiles that were searched in it.
    pub high_resolution: Vec<u32>,
    pub regions: Vec<RegionView>,
    /// Views of the plan that were cut, and those that were not.
    pub views: [u32; 2],
    pub markers: Vec<Detected>,
    pub tracks: Vec<TrackSummary>,
    /// Turns directions in the camera frame of the frame before into this one's: x, y, z, w; absent
    /// where it is not known.
    pub turn: Option<[f32; 4]>,
    /// True poses of the neighbours in a simulated flight.
    pub truth: Vec<Truth>,
    /// In a recording: when it ended, seconds from the recording's beginning; absent of a running
    /// pipeline.
    pub at_s: Option<f64>,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RegionView {
    /// Number of the body that it was cut for.
    pub target: u32,
    pub view: ViewSquare,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Detected {
    /// Its number in the dictionary.
    pub id: u32,
    /// Whether the marker was not decoded and only looks like this one.
    pub doubtful: bool,
    /// Unit rays of its corners in the camera frame.
    pub rays: [[f32; 3]; 4],
}

/// A neighbour in a frame.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TrackSummary {
    /// Number of its body.
    pub target: u32,
    pub name: String,
    /// Number of the track.
    pub track: u32,
    /// `tentative`, `confirmed`, `coasting`, `lost` or `measured`.
    pub state: &'static str,
    /// `nothing`, `decoded` or `aligned`.
    pub by: &'static str,
    pub markers: u32,
    /// `observer_from_target`.
    pub pose: PagePose,
    /// Covariance of the position in the observer's frame, m^2: xx, xy, xz, yy, yz, zz.
    pub covariance: [f32; 6],
    /// Standard deviation of the attitude, over all axes together, degrees.
    pub attitude_deg: f32,
    /// Velocity along the observer's axes, m/s.
    pub velocity: [f32; 3],
    /// Seconds since it was measured, and since the track began.
    pub unseen_s: f32,
    pub age_s: f32,
    /// Milliseconds of capture, rectification, detection, fusion, and all together; absent where
    /// unknown.
    pub latency_ms: [Option<f32>; 5],
}

/// Where a simulated neighbour really is.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Truth {
    /// Number of its body.
    pub target: u32,
    /// `observer_from_target`.
    pub pose: PagePose,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ProcessReport {
    pub stage: String,
    /// Which worker.
    pub replica: u32,
    /// How often it was replaced.
    pub generation: u32,
    /// `starting`, `ready`, `draining`, `finished`, `degraded` or `silent`.
    pub state: &'static str,
    /// What it works with, for people.
    pub detail: String,
    /// Messages taken in each second.
    pub taken_per_s: f32,
    /// Messages sent each second.
    pub published_per_s: f32,
    /// Messages dropped, and refused, since it started.
    pub dropped: u64,
    pub failed: u64,
    /// What it works on now.
    pub queued: u64,
    /// Share of a processor.
    pub processor: f32,
    pub resident_mb: f32,
    /// Median and 99 % quantile of its latency, milliseconds; absent where nothing was done yet.
    pub latency_ms: Option<[f32; 2]>,
}

/// Where a drone of the swarm is.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DroneSummary {
    pub name: String,
    /// Pose in this drone's frame.
    pub pose: PagePose,
    /// Covariance of the position as in [`TrackSummary`].
    pub covariance: [f32; 6],
    /// `direct`, `mutual`, `reported` or `chained`.
    pub way: &'static str,
    /// The drone through which it is known, if it is `chained`.
    pub through: String,
    /// Age of the newest exposure that it rests on, seconds.
    pub age_s: f32,
}

/// Where a peer sees somebody.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SightingSummary {
    pub observer: String,
    pub target: String,
    pub state: &'static str,
    pub range_m: f32,
    /// Age of the exposure, seconds.
    pub age_s: f32,
}

/// An overview of a recording: its time in equal parts, each with what is worst in it.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Overview {
    /// Share of the recording that has been read for it, 0 to 1.
    pub done: f32,
    /// The slowest neighbour's latency as in [`TrackSummary`]; absent where there is none.
    pub latency_ms: Vec<Option<[Option<f32>; 5]>>,
    pub states: Vec<TargetStates>,
    /// Frames that never ended.
    pub skipped: Vec<u32>,
    /// Messages that are, or may be, missing in the recording.
    pub lost: Vec<u32>,
    /// What is missing of each topic.
    pub losses: Vec<TopicLoss>,
}

/// States of a neighbour's track over a recording.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TargetStates {
    /// Number of its body.
    pub target: u32,
    /// In each part of the recording the worst state; absent where nothing is said.
    pub states: Vec<Option<&'static str>>,
}

/// What a recording lacks of a topic.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TopicLoss {
    pub topic: String,
    pub recorded: u64,
    /// Messages that are, or may be, missing.
    pub lost: u64,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CloseupHead {
    pub key: String,
    /// Number of the body.
    pub target: u32,
    /// Sides of one panel, pixels.
    pub size: [u32; 2],
    /// Panels in the JPEG: picture, then model and residual where the body could be compared.
    pub panels: u32,
    /// How well both agree, where it could be compared.
    pub score: Option<Likeness>,
}

/// How well the picture and the model agree.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Likeness {
    /// Mean normalized correlation of the cells.
    pub correlation: f32,
    /// Log odds of the body being there, by the pixels alone.
    pub log_odds: f32,
    /// Facets that agree.
    pub facets: u32,
}

/// The name of a frame: generation of the source, epoch, sequence.
pub fn key(stamp: &FrameStamp) -> String {
    format!("{}.{}.{}", stamp.source_generation, stamp.epoch, stamp.sequence)
}

/// A text message as it goes over the wire.
pub fn text(message: &TextMessage<'_>) -> Message {
    // These types have no maps with other keys than texts, so they always have a JSON form.
    Message::text(serde_json::to_string(message).unwrap_or_default())
}

/// A binary message: the length of the head (4 bytes, little endian), the head as JSON, the JPEG.
pub fn binary(head: &BinaryHead, jpeg: &[u8]) -> Message {
    // As above.
    let head = serde_json::to_vec(head).unwrap_or_default();
    let length = u32::try_from(head.len()).unwrap_or(0).to_le_bytes();
    Message::binary([&length[..], &head, jpeg].concat())
}

#[cfg(test)]
mod tests;
