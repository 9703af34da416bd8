//! Settings of a source.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use flockeye_config::{AtEnd, Flow, InertialSource, Pipeline};

/// Settings of a source.
#[derive(Debug, Clone)]
pub struct SourceParameters {
    /// Pixels in a row that frames must have.
    pub width: u32,
    /// Rows that frames must have.
    pub height: u32,
    /// Flow control. [`Flow::Latest`]: real time, by the stream's time stamps. A waiting frame is
    /// replaced by a newer one, and a recording that decodes too slowly plays slower.
    /// [`Flow::Lossless`]: the consumer gets every frame in order.
    pub flow: Flow,
    /// Whether a recording starts again at its end.
    pub looping: bool,
    /// Latency from exposure to arrival; subtracted from the arrival of a camera's frames.
    pub latency: Duration,
    /// Timeout without a frame after which a camera counts as lost.
    pub stall: Duration,
    /// First wait before a lost camera is opened again.
    pub reopen_min: Duration,
    /// Maximum wait before a lost camera is opened again.
    pub reopen_max: Duration,
    /// Images of a folder per second.
    pub images_per_second: f64,
    /// Whether the inertial samples of a recorded flight are read.
    pub samples: bool,
    /// Whether coded pictures are requested.
    pub packets: Arc<AtomicBool>,
    /// Threads of the software decoder; 0: chosen by the decoder. More than 1: frame threads for a
    /// camera.
    pub decoder_threads: u32,
}

impl SourceParameters {
    /// Frames of `width` x `height` in real time, everything else at its default.
    pub fn new(width: u32, height: u32) -> Self {
        Self {
            width,
            height,
            flow: Flow::Latest,
            looping: false,
            latency: Duration::ZERO,
            stall: Duration::from_secs(5),
            reopen_min: Duration::from_millis(500),
            reopen_max: Duration::from_secs(10),
            images_per_second: 1.0,
            samples: false,
            packets: Arc::default(),
            decoder_threads: 0,
        }
    }

    /// The settings in a configuration.
    pub fn of(pipeline: &Pipeline) -> Self {
        let seconds = |s: f64| Duration::try_from_secs_f64(s).unwrap_or(Duration::from_secs(1));
        Self {
            flow: pipeline.flow(),
            looping: pipeline.source.at_end == AtEnd::Loop,
            latency: seconds(pipeline.camera.latency_ms * 1e-3),
            reopen_min: seconds(pipeline.source.reopen_s[0]),
            reopen_max: seconds(pipeline.source.reopen_s[1]),
            images_per_second: pipeline.source.images_per_second,
            samples: pipeline.inertial.parsed_source() == Ok(InertialSource::Recording),
            decoder_threads: pipeline.source.decoder_threads,
            ..Self::new(pipeline.camera.width, pipeline.camera.height)
        }
    }
}
