//! The messages to the page. docs/VIEW.md describes them; a test compares it with this file.
//!
//! Numbers are of single precision: a page draws with them, and nobody measures by them.

use flockeye_contract::FrameStamp;
use serde::Serialize;

/// Version of these messages. A page of another version asks to be loaded again.
pub const PROTOCOL: u32 = 1;

/// A message as text.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Text {
    /// The first message, and again where a pipeline has started anew.
    Hello(Box<Hello>),
    /// A frame has ended.
    Frame(Box<Frame>),
    /// What the stages report.
    Stages(Stages),
    /// What the peers report, and where all drones are.
    Swarm(Swarm),
    /// What is wrong with the view itself.
    Status(Status),
}

/// The head of a binary message; a JPEG follows it.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Head {
    /// A frame's picture, equirectangular.
    Picture(PictureHead),
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
    pub observer_from_camera: Pose,
    /// Tiles of the sphere.
    pub partitions: Vec<Square>,
    /// High-resolution tiles.
    pub high_resolution: Vec<Square>,
    /// The neighbours' bodies, by their `target` numbers.
    pub bodies: Vec<Body>,
    /// Names of the stages that run.
    pub stages: Vec<&'static str>,
    /// Pictures a second, at most.
    pub rate: f32,
}

/// A pose `a_from_b`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Pose {
    /// Metres.
    pub p: [f32; 3],
    /// Unit quaternion x, y, z, w.
    pub q: [f32; 4],
}

/// A square pinhole view.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Square {
    /// `camera_from_view`: unit quaternion x, y, z, w.
    pub q: [f32; 4],
    /// Half of its side, at distance 1 along its axis.
    pub half: f32,
}

/// A marker body.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Body {
    /// Its name.
    pub name: String,
    /// Where it sits on its drone.
    pub target_from_markers: Pose,
    /// Outlines of its flat sides in the markers' frame, metres.
    pub facets: Vec<Vec<[f32; 3]>>,
    /// Its markers.
    pub markers: Vec<Marker>,
}

/// A marker of a body.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Marker {
    /// Its number in the dictionary.
    pub id: u32,
    /// Corners of the black square in the markers' frame, metres.
    pub corners: [[f32; 3]; 4],
}

/// A frame that has ended.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Frame {
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
    /// Regions of interest.
    pub regions: Vec<Region>,
    /// Views of the plan that were cut, and those that were not.
    pub views: [u32; 2],
    /// Detected markers.
    pub markers: Vec<Detected>,
    /// The neighbours.
    pub tracks: Vec<Track>,
    /// Turns directions in the camera frame of the frame before into this one's: x, y, z, w; absent where
    /// it is not known.
    pub turn: Option<[f32; 4]>,
    /// Of a simulated flight: where the neighbours really are.
    pub truth: Vec<Truth>,
}

/// A region of interest.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Region {
    /// Number of the body that it was cut for.
    pub target: u32,
    /// The view.
    pub view: Square,
}

/// A detected marker.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Detected {
    /// Its number in the dictionary.
    pub id: u32,
    /// Whether it was not decoded and only looks like this marker.
    pub doubtful: bool,
    /// Unit rays of its corners in the camera frame.
    pub rays: [[f32; 3]; 4],
}

/// A neighbour in a frame.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Track {
    /// Number of its body.
    pub target: u32,
    /// Its name.
    pub name: String,
    /// Number of the track.
    pub track: u32,
    /// `tentative`, `confirmed`, `coasting`, `lost` or `measured`.
    pub state: &'static str,
    /// `nothing`, `decoded` or `aligned`.
    pub by: &'static str,
    /// Markers decoded.
    pub markers: u32,
    /// `observer_from_target`.
    pub pose: Pose,
    /// Covariance of the position in the observer's frame, m^2: xx, xy, xz, yy, yz, zz.
    pub covariance: [f32; 6],
    /// Standard deviation of the attitude, over all axes together, degrees.
    pub attitude_deg: f32,
    /// Velocity along the observer's axes, m/s.
    pub velocity: [f32; 3],
    /// Seconds since it was measured, and since the track began.
    pub unseen_s: f32,
    /// See `unseen_s`.
    pub age_s: f32,
    /// Milliseconds of capture, rectification, detection, fusion, and all together; absent where unknown.
    pub latency_ms: [Option<f32>; 5],
}

/// Where a simulated neighbour really is.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Truth {
    /// Number of its body.
    pub target: u32,
    /// `observer_from_target`.
    pub pose: Pose,
}

/// What the stages report.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Stages {
    /// One for each process.
    pub stages: Vec<Stage>,
}

/// One process of a stage.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Stage {
    /// Its stage.
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
    /// See `dropped`.
    pub failed: u64,
    /// What it works on now.
    pub queued: u64,
    /// Share of a processor.
    pub processor: f32,
    /// Resident memory, megabytes.
    pub resident_mb: f32,
    /// Median and 99 % quantile of its latency, milliseconds; absent where nothing was done yet.
    pub latency_ms: Option<[f32; 2]>,
}

/// What the peers report.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Swarm {
    /// Where all drones are.
    pub drones: Vec<Drone>,
    /// Who sees whom.
    pub sightings: Vec<Sighting>,
}

/// Where a drone of the swarm is.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Drone {
    /// Its name.
    pub name: String,
    /// Pose in this drone's frame.
    pub pose: Pose,
    /// Covariance of the position as in [`Track`].
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
pub struct Sighting {
    /// Who sees.
    pub observer: String,
    /// Who is seen.
    pub target: String,
    /// State of the track.
    pub state: &'static str,
    /// Distance, metres.
    pub range_m: f32,
    /// Age of the exposure, seconds.
    pub age_s: f32,
}

/// What is wrong with the view itself.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Status {
    /// Whether the pipeline runs.
    pub running: bool,
    /// Why there are no pictures, for people; empty where there are.
    pub trouble: String,
}

/// Head of a picture.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PictureHead {
    /// The frame.
    pub key: String,
    /// Sides, pixels.
    pub size: [u32; 2],
}

/// Head of a close-up.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CloseupHead {
    /// The frame.
    pub key: String,
    /// Number of the body.
    pub target: u32,
    /// Sides of one panel, pixels.
    pub size: [u32; 2],
    /// Panels in the JPEG: picture, then model and residual where the body could be compared.
    pub panels: u32,
    /// How well both agree, where it could be compared.
    pub score: Option<Score>,
}

/// How well the picture and the model agree.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Score {
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
pub fn text(message: &Text) -> String {
    // These types have no maps with other keys than texts, so they always have a JSON form.
    serde_json::to_string(message).unwrap_or_default()
}

/// A binary message: the length of the head (4 bytes, little endian), the head as JSON, the JPEG.
pub fn binary(head: &Head, jpeg: &[u8]) -> Vec<u8> {
    // As above.
    let head = serde_json::to_vec(head).unwrap_or_default();
    let length = u32::try_from(head.len()).unwrap_or(0).to_le_bytes();
    [&length[..], &head, jpeg].concat()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use flockeye_config::{Pipeline, Resolved};
    use serde_json::Value;

    use super::*;
    use crate::scene::Scene;
    use crate::stages::StageReports;

    /// Whoever writes a page reads VIEW.md.
    #[test]
    fn the_document_names_every_key() {
        let document = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/VIEW.md");
        let document = std::fs::read_to_string(document).unwrap();
        let names = |value: &Value| value.as_object().unwrap().keys().cloned().collect::<Vec<_>>();
        let resolved = Resolved::of(Pipeline::default()).unwrap();
        let hello = Text::Hello(Box::new(crate::setting::hello(&resolved, "x", 1.0)));
        let header = flockeye_contract::TrackHeader { is_last: 1, ..Default::default() };
        let track: flockeye_contract::Track = bytemuck::Zeroable::zeroed();
        let ended = Scene::new(true).tracks(&header, &[track], 0).unwrap();
        let mut reports = StageReports::default();
        reports.health(&Default::default());
        let stages = reports.shown(0);
        let track = serde_json::to_value(&ended.message.tracks[0]).unwrap();
        let stage = serde_json::to_value(&stages.stages[0]).unwrap();
        let messages = [
            hello,
            Text::Frame(Box::new(ended.message)),
            Text::Stages(stages),
            Text::Swarm(Swarm { drones: Vec::new(), sightings: Vec::new() }),
            Text::Status(Status::default()),
        ];
        let mut values: Vec<Value> =
            messages.iter().map(|message| serde_json::from_str(&text(message)).unwrap()).collect();
        let picture = Head::Picture(PictureHead { key: String::new(), size: [1, 1] });
        let closeup =
            CloseupHead { key: String::new(), target: 0, size: [1, 1], panels: 1, score: None };
        values.extend(
            [picture, Head::Closeup(closeup)].map(|head| serde_json::to_value(head).unwrap()),
        );
        for value in &values {
            let kind = value["kind"].as_str().unwrap();
            assert!(document.contains(&format!("| `{kind}` |")), "{kind}");
        }
        values.extend([track, stage]);
        for name in values.iter().flat_map(names) {
            assert!(document.contains(&format!("`{name}`")), "{name} is not in VIEW.md");
        }
    }

    #[test]
    fn a_binary_message_says_where_its_picture_begins() {
        let head = Head::Picture(PictureHead { key: "0.1.2".into(), size: [4, 2] });
        let message = binary(&head, b"jpeg");
        let length = u32::from_le_bytes(message[..4].try_into().unwrap()) as usize;
        let read: Value = serde_json::from_slice(&message[4..4 + length]).unwrap();
        assert_eq!((read["kind"].as_str(), read["key"].as_str()), (Some("picture"), Some("0.1.2")));
        assert_eq!(&message[4 + length..], b"jpeg");
    }
}
