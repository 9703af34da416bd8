//! The messages to the page. docs/RECORDING.md describes them; a test compares it with this file.
//!
//! Numbers have single precision: a page only draws with them.

use flockeye_contract::FrameStamp;
use serde::Serialize;
use tungstenite::Message;

use crate::outbox::OutboxKind;

/// Version of these messages. A page of another version must be reloaded.
pub(crate) const PROTOCOL: u32 = 1;

/// A message as text.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub(crate) enum TextMessage<'m> {
    /// The first message; it is repeated where a pipeline was restarted.
    Hello(&'m Hello),
    Frame(&'m FrameMessage),
    /// Reports of the stages.
    Stages {
        /// One report for each process.
        stages: &'m [ProcessReport],
    },
    Swarm {
        drones: &'m [DroneSummary],
        /// Sightings: which drone sees which.
        sightings: &'m [SightingSummary],
    },
    /// State of the view itself.
    Status {
        running: bool,
        /// The reason why there are no pictures, for people; empty where there are.
        trouble: &'m str,
    },
    /// The frame of a recording that is shown now. Its messages came before.
    Position {
        /// The frame; absent where the recording has none.
        key: Option<&'m str>,
        /// The time that is shown, seconds from the recording's beginning.
        at_s: f64,
        /// Speed of playback, recorded seconds per second; 0: paused.
        speed: f64,
        /// The frame of the nearest picture before, if there is one.
        picture: Option<&'m str>,
        /// Number of the page's commands that were done.
        answers: u64,
    },
    /// An overview of a whole recording.
    Overview(&'m Overview),
}

impl TextMessage<'_> {
    /// The kind by which it waits for a page that follows a running pipeline.
    pub(crate) fn kind(&self) -> OutboxKind {
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
pub(crate) enum BinaryHead {
    /// A frame's picture, equirectangular.
    Picture {
        key: String,
        /// Width and height, pixels.
        size: [u32; 2],
    },
    /// A neighbour's close-up: panels side by side.
    Closeup(CloseupHead),
}

/// The page's first message.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct Hello {
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
    /// Width and height of the camera's frames, pixels.
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
    /// Maximum pictures per second.
    pub rate: f32,
    /// The recording that is shown; absent where it is a running pipeline.
    pub recording: Option<RecordingSummary>,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct RecordingSummary {
    pub file: String,
    /// Start time, UTC seconds since 1970.
    pub began_s: f64,
    /// Duration, seconds.
    pub duration_s: f64,
    /// Whether the recording has pictures of frames.
    pub pictures: bool,
}

/// A pose `a_from_b`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub(crate) struct PagePose {
    /// Position, metres.
    pub p: [f32; 3],
    /// Unit quaternion x, y, z, w.
    pub q: [f32; 4],
}

/// A square pinhole view.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub(crate) struct ViewSquare {
    /// `camera_from_view`: unit quaternion x, y, z, w.
    pub q: [f32; 4],
    /// Half of its width, at distance 1 along its axis.
    pub half: f32,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct PageBody {
    pub name: String,
    /// Pose of the markers' frame in the drone's frame.
    pub target_from_markers: PagePose,
    /// Outlines of its flat sides in the markers' frame, metres.
    pub facets: Vec<Vec<[f32; 3]>>,
    pub markers: Vec<PageMarker>,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct PageMarker {
    /// Its number in the dictionary.
    pub id: u32,
    /// Corners of the black square in the markers' frame, metres.
    pub corners: [[f32; 3]; 4],
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct FrameMessage {
    /// The frame's key: see [`key`].
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
    /// Numbers of the plan's views that were cut, and that were not.
    pub views: [u32; 2],
    pub markers: Vec<Detected>,
    pub tracks: Vec<TrackSummary>,
    /// Rotation from the camera frame of the previous frame to this one's: x, y, z, w. Absent where
    /// unknown.
    pub turn: Option<[f32; 4]>,
    /// True poses of the neighbours in a simulated flight.
    pub truth: Vec<Truth>,
    /// Time at which it ended, seconds from the recording's beginning; absent for a running
    /// pipeline.
    pub at_s: Option<f64>,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct RegionView {
    /// Number of the body that it was cut for.
    pub target: u32,
    pub view: ViewSquare,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct Detected {
    /// Its number in the dictionary.
    pub id: u32,
    /// Unit rays of its corners in the camera frame.
    pub rays: [[f32; 3]; 4],
}

/// A neighbour in a frame.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct TrackSummary {
    /// Number of its body.
    pub target: u32,
    pub name: String,
    /// Number of the track.
    pub track: u32,
    /// `tentative`, `confirmed`, `coasting`, `ambiguous`, `lost` or `measured`.
    pub state: &'static str,
    /// `nothing`, `decoded` or `aligned`.
    pub by: &'static str,
    pub markers: u32,
    /// `observer_from_target`.
    pub pose: PagePose,
    /// The other possible pose of an ambiguous track.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rival: Option<PagePose>,
    /// Covariance of the position in the observer's frame, m^2: xx, xy, xz, yy, yz, zz.
    pub covariance: [f32; 6],
    /// Standard deviation of the attitude, over all three axes together, degrees.
    pub attitude_deg: f32,
    /// Velocity along the observer's axes, m/s.
    pub velocity: [f32; 3],
    /// Seconds since the last measurement, and since the track began.
    pub unseen_s: f32,
    pub age_s: f32,
    /// Milliseconds of capture, rectification, detection, fusion, and in total; absent where
    /// unknown.
    pub latency_ms: [Option<f32>; 5],
}

/// True pose of a simulated neighbour.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct Truth {
    /// Number of its body.
    pub target: u32,
    /// `observer_from_target`.
    pub pose: PagePose,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct ProcessReport {
    pub stage: String,
    /// Number of the worker.
    pub replica: u32,
    /// Number of replacements.
    pub generation: u32,
    /// `starting`, `ready`, `draining`, `finished`, `degraded` or `silent`.
    pub state: &'static str,
    /// Details of its work, for people.
    pub detail: String,
    /// Messages taken in each second.
    pub taken_per_s: f32,
    /// Messages sent each second.
    pub published_per_s: f32,
    /// Messages dropped, and failed, since it started.
    pub dropped: u64,
    pub failed: u64,
    /// Number of messages that it works on now.
    pub queued: u64,
    /// Processor load; 1 is one whole processor.
    pub processor: f32,
    pub resident_mb: f32,
    /// Median and 99 % quantile of its latency, milliseconds; absent before the first message.
    pub latency_ms: Option<[f32; 2]>,
}

/// Pose of a drone of the swarm.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct DroneSummary {
    pub name: String,
    /// Pose in this drone's frame.
    pub pose: PagePose,
    /// Covariance of the position as in [`TrackSummary`].
    pub covariance: [f32; 6],
    /// `direct`, `mutual`, `reported` or `chained`.
    pub way: &'static str,
    /// The drone before it on the chain of sightings, if it is `chained`.
    pub through: String,
    /// Age of the newest exposure behind the pose, seconds.
    pub age_s: f32,
}

/// A peer's sighting of another drone.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct SightingSummary {
    pub observer: String,
    pub target: String,
    pub state: &'static str,
    pub range_m: f32,
    /// Age of the exposure, seconds.
    pub age_s: f32,
}

/// An overview of a recording: its time in equal parts, each with its worst values.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub(crate) struct Overview {
    /// Share of the recording that has been read, 0 to 1.
    pub done: f32,
    /// Latency of the slowest neighbour, as in [`TrackSummary`]; absent where there is none.
    pub latency_ms: Vec<Option<[Option<f32>; 5]>>,
    pub states: Vec<TargetStates>,
    /// Frames that never ended.
    pub skipped: Vec<u32>,
    /// Messages that are, or may be, missing in the recording.
    pub lost: Vec<u32>,
    /// Missing messages by topic.
    pub losses: Vec<TopicLoss>,
}

/// States of a neighbour's track over a recording.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct TargetStates {
    /// Number of its body.
    pub target: u32,
    /// The worst state in each part of the recording; absent where there is none.
    pub states: Vec<Option<&'static str>>,
}

/// Missing messages of a topic.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct TopicLoss {
    pub topic: String,
    pub recorded: u64,
    /// Messages that are, or may be, missing.
    pub lost: u64,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct CloseupHead {
    pub key: String,
    /// Number of the body.
    pub target: u32,
    /// Width and height of one panel, pixels.
    pub size: [u32; 2],
    /// Panels in the JPEG: picture, then model and residual where the body could be compared.
    pub panels: u32,
    /// Agreement of the two, where the body could be compared.
    pub score: Option<Likeness>,
}

/// Agreement of the picture and the model.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub(crate) struct Likeness {
    /// Mean normalized correlation of the cells.
    pub correlation: f32,
    /// Log odds that the body is there, from the pixels alone.
    pub log_odds: f32,
    /// Number of facets that agree.
    pub facets: u32,
}

/// The key of a frame: generation of the source, epoch, sequence.
pub(crate) fn key(stamp: &FrameStamp) -> String {
    format!("{}.{}.{}", stamp.source_generation, stamp.epoch, stamp.sequence)
}

/// Encodes a text message.
pub(crate) fn text(message: &TextMessage<'_>) -> Message {
    // All map keys in these types are strings, so a JSON form always exists.
    Message::text(serde_json::to_string(message).unwrap_or_default())
}

/// A binary message: the length of the head (4 bytes, little endian), the head as JSON, the JPEG.
pub(crate) fn binary(head: &BinaryHead, jpeg: &[u8]) -> Message {
    // The head always has a JSON form, as above.
    let head = serde_json::to_vec(head).unwrap_or_default();
    let length = u32::try_from(head.len()).unwrap_or(0).to_le_bytes();
    Message::binary([&length[..], &head, jpeg].concat())
}

#[cfg(test)]
mod tests;
