//! Where frames come from: `source`.

use std::path::Path;

use flockeye_contract::StageName;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Where frames come from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Source {
    /// `sim`, a video file, a recording of a flight (`FILE.mcap`), a folder of images, `v4l2:/dev/video0`, `theta`,
    /// or a GStreamer description (with a `!` in it, or behind `gst:`).
    pub input: String,
    /// What happens at the end of a recording.
    pub at_end: AtEnd,
    /// Pace of a folder of images in real time, images a second.
    #[schemars(range(min = 0.01, max = 1000.0))]
    pub images_per_second: f64,
    /// Threads of a software video decoder; 0 lets it choose, so that a camera's frames are not held back.
    /// More than 1: as many frames of a camera at a time, each but one of them held back.
    #[schemars(range(min = 0, max = 64))]
    pub decoder_threads: u32,
    /// First and longest wait before a camera that went away is opened again, seconds.
    pub reopen_s: [f64; 2],
}

impl Default for Source {
    fn default() -> Self {
        Self {
            input: "sim".into(),
            at_end: AtEnd::Stop,
            images_per_second: 1.0,
            decoder_threads: 0,
            reopen_s: [0.5, 8.0],
        }
    }
}

impl Source {
    /// The stage that `input` needs.
    pub fn stage(&self) -> StageName {
        if self.input == "sim" { StageName::Simulator } else { StageName::Capture }
    }

    /// Whether `input` is the recording of a flight.
    pub fn is_flight(&self) -> bool {
        self.has_extension(&["mcap"])
    }

    /// Whether `input` may be video: it is neither simulated, nor an image or a folder of images.
    pub fn may_be_video(&self) -> bool {
        let is_images =
            self.has_extension(&["jpg", "jpeg", "png"]) || Path::new(self.input.trim()).is_dir();
        self.stage() == StageName::Capture && !is_images
    }

    /// Whether `input` may have coded pictures that can be recorded as they come. A recording of a flight has them,
    /// and does not pass them on.
    pub fn may_send_packets(&self) -> bool {
        self.may_be_video() && !self.is_flight()
    }

    fn has_extension(&self, extensions: &[&str]) -> bool {
        let own = Path::new(self.input.trim()).extension();
        own.is_some_and(|own| {
            extensions.iter().any(|extension| own.eq_ignore_ascii_case(extension))
        })
    }
}

/// What happens at the end of a recording.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum AtEnd {
    /// The pipeline stops.
    #[default]
    Stop,
    /// It begins again, with the next epoch.
    Loop,
}
