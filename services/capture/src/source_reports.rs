//! Reports about a source, in the log and in the stage's health.

use std::time::Duration;

use flockeye_config::{Coding, Pipeline};
use flockeye_contract::StageState;
use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::logs::Throttle;

use crate::{EndReason, FrameSource};

/// Reports about one source.
pub(crate) struct SourceReports {
    counters: SharedCounters,
    /// Whether a frame has arrived since the source was last opened.
    has_begun: bool,
    /// Until the first frame: whether `fusion.coding: auto` was resolved to video.
    is_video_guessed: bool,
    losses: Throttle,
    skips: Throttle,
}

impl SourceReports {
    /// Reports a source that was opened for `pipeline`.
    pub(crate) fn new(pipeline: &Pipeline, source: &FrameSource, counters: SharedCounters) -> Self {
        tracing::info!("{}", source.describe());
        counters.set_detail(source.describe());
        let is_auto = pipeline.fusion.coding == Coding::Auto;
        Self {
            counters,
            has_begun: false,
            is_video_guessed: is_auto && pipeline.is_coded_as_video(),
            losses: Throttle::default(),
            skips: Throttle::default(),
        }
    }

    /// Notes a frame. The first frame makes facts known, which are reported then; a recording's
    /// decoder is known before.
    pub(crate) fn frame(&mut self, source: &FrameSource) {
        self.counters.set_state(None);
        if std::mem::replace(&mut self.has_begun, true) {
            return;
        }
        if source.is_camera() {
            let described = source.describe();
            tracing::info!("{described}");
            self.counters.set_detail(described);
        }
        if std::mem::take(&mut self.is_video_guessed) && !source.decodes_video() {
            tracing::warn!(
                "no video is decoded here, but covariances are those of video, three times as large. Cure: \
                 fusion.coding: images, or video where the pictures were video before they came here"
            );
        }
    }

    /// Reports an unusable picture.
    pub(crate) fn skipped(&mut self, what: &str, why: &str) {
        self.counters.add_failed(1);
        if let Some(more) = self.skips.admit() {
            tracing::warn!(more_since = more, "{what} is left out: {why}");
        }
    }

    /// Reports an avoidable latency.
    pub(crate) fn late(&self, what: &str, source: &FrameSource) {
        tracing::warn!("{what}");
        self.counters.set_detail(source.describe());
    }

    pub(crate) fn lost(&mut self, reason: &str, retry_in: Duration) {
        self.counters.set_state(Some(StageState::Degraded));
        self.has_begun = false;
        if let Some(more) = self.losses.admit() {
            tracing::warn!(
                more_since = more,
                "{reason}; the source is opened again in {:.1} s",
                retry_in.as_secs_f64()
            );
        }
    }

    pub(crate) fn ended(&self, reason: &EndReason) {
        match reason {
            EndReason::Complete { .. } => tracing::info!("the recording is {reason}"),
            EndReason::Truncated { .. } => tracing::warn!("the recording {reason}"),
        }
    }
}
