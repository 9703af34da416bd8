//! Recordings of every flight.

use std::path::PathBuf;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// What is recorded of every flight, as `flockeye record` does: docs/RECORDING.md.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Recording {
    /// The folder of the recordings, one for each flight. Left out: nothing is recorded.
    pub folder: Option<PathBuf>,
    /// none: headers alone. views: the pixels of all views. camera: the source's own H.264 or H.265, as it came. every: a
    /// frame now and then, as JPEG.
    pub frames: RecordedFrames,
    /// With `frames: every`: of so many frames one is recorded.
    #[schemars(range(min = 1, max = 1_000_000))]
    pub every: u32,
    /// Left out: everything is recorded. lost: what came before a neighbour's track was lost, or before
    /// `flockeye record --now`. request: before that command alone.
    pub trigger: Option<RecordingTrigger>,
    /// With `trigger`: how much of the past is kept, seconds.
    #[schemars(range(min = 1.0, max = 600.0))]
    pub past_s: f64,
}

impl Default for Recording {
    fn default() -> Self {
        Self { folder: None, frames: RecordedFrames::None, every: 30, trigger: None, past_s: 30.0 }
    }
}

/// Which pictures are recorded.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum RecordedFrames {
    /// Headers alone.
    #[default]
    None,
    /// The pixels of all views.
    Views,
    /// The source's own coded pictures, as they came.
    Camera,
    /// A frame now and then, as JPEG.
    Every,
}

/// When a recorder that keeps the past writes it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum RecordingTrigger {
    /// A neighbour's track is lost, or on request.
    Lost,
    /// On request alone.
    Request,
}
