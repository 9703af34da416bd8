//! The capture stage: moves pictures from a source to the port.

use std::time::Duration;

use flockeye_config::{Coding, Pipeline};
use flockeye_contract::{FrameHeader, Frames, PixelFormat, Projection, StageState, Transfer};
use flockeye_convert::projection_of;
use flockeye_runtime::credits::Credits;
use flockeye_runtime::findings::Finding;
use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::logs::Throttle;
use flockeye_runtime::ports::{Ports, Publisher};
use flockeye_runtime::{Context, Stage, Step, clock};

use crate::core::{Core, Stamped};
use crate::examine;
use crate::inertial::InertialPort;
use crate::packet_port::PacketPort;
use crate::{EndReason, Event, Picture, Source, SourceParameters, SourceSpec};

/// How long the source is waited for between two looks at everything else.
const WAIT: Duration = Duration::from_millis(50);

/// Takes nothing (in a lossless run: plans, as credits); gives frames, the samples of a
/// recording's inertial sensor, and coded pictures where somebody wants them.
pub struct CaptureStage {
    frames: Publisher<Frames>,
    inertial: Option<InertialPort>,
    packets: PacketPort,
    credits: Credits,
    source: Source,
    core: Core,
    transfer: (Transfer, f32),
    projection: Projection,
    readout_ns: u64,
    counters: SharedCounters,
    /// Whether a frame of the source as it is open now has come.
    has_begun: bool,
    /// Until the first frame: whether `fusion.coding: auto` was taken as video.
    is_video_guessed: bool,
    losses: Throttle,
    skips: Throttle,
}

impl Stage for CaptureStage {
    const NAME: &'static str = "capture";

    fn open(context: &Context, ports: &mut Ports) -> anyhow::Result<Self> {
        let resolved = &context.resolved;
        let pipeline = &resolved.pipeline;
        let spec: SourceSpec = pipeline.source.input.parse()?;
        let parameters = SourceParameters::of(pipeline);
        // Before the source is opened, so that a recorder gets its first packet.
        let generation = context.identity.generation;
        let packets = PacketPort::open(pipeline, generation, parameters.packets.clone(), ports)?;
        let source = Source::open(spec, parameters)?;
        tracing::info!("{}", source.describe());
        context.counters.set_detail(source.describe());
        Ok(Self {
            frames: ports.publisher()?,
            inertial: InertialPort::open(pipeline, context.identity.generation, ports)?,
            packets,
            credits: Credits::open(pipeline, ports)?,
            source,
            core: Core::new(pipeline.flow(), context.identity.generation),
            transfer: resolved.transfer,
            projection: projection_of(&resolved.camera),
            readout_ns: (pipeline.camera.readout_ms * 1e6) as u64,
            counters: context.counters.clone(),
            has_begun: false,
            is_video_guessed: pipeline.fusion.coding == Coding::Auto
                && pipeline.is_coded_as_video(),
            losses: Throttle::default(),
            skips: Throttle::default(),
        })
    }

    fn examine(pipeline: &Pipeline) -> Vec<Finding> {
        examine::examine(pipeline)
    }

    fn step(&mut self) -> anyhow::Result<Step> {
        self.packets.attend(&self.source, self.core.epoch())?;
        if !self.credits.may_send()? {
            return Ok(Step::WaitUntil(clock::monotonic_ns() + 100_000_000));
        }
        if self.core.has_ended() {
            return Ok(Step::Finished);
        }
        match self.source.next(WAIT)? {
            Event::Frame(picture) => self.send(&picture)?,
            Event::Idle => {}
            Event::Skipped { what, why } => {
                self.counters.add_failed(1);
                if let Some(more) = self.skips.admit() {
                    tracing::warn!(more_since = more, "{what} is left out: {why}");
                }
            }
            Event::NewEpoch => {
                tracing::info!("the recorded source begins anew");
                self.begin_epoch();
            }
            Event::Looped { after } => {
                tracing::debug!("{after}; it begins again");
                self.begin_epoch();
            }
            Event::Late { what } => {
                tracing::warn!("{what}");
                self.counters.set_detail(self.source.describe());
            }
            Event::Lost { reason, retry_in } => {
                self.counters.set_state(Some(StageState::Degraded));
                self.has_begun = false;
                if let Some(more) = self.losses.admit() {
                    tracing::warn!(
                        more_since = more,
                        "{reason}; the source is opened again in {:.1} s",
                        retry_in.as_secs_f64()
                    );
                }
                self.begin_epoch();
            }
            Event::End(reason) => {
                match &reason {
                    EndReason::Complete { .. } => tracing::info!("the recording is {reason}"),
                    EndReason::Truncated { .. } => tracing::warn!("the recording {reason}"),
                }
                self.core.end();
            }
        }
        Ok(Step::Again)
    }
}

impl CaptureStage {
    fn begin_epoch(&mut self) {
        self.core.begin_epoch();
        if let Some(inertial) = &mut self.inertial {
            inertial.begin_epoch();
        }
    }

    /// Says what is known from the first frame on. What decodes a recording is known before.
    fn tell_of_decoder(&mut self) {
        if self.source.is_camera() {
            let described = self.source.describe();
            tracing::info!("{described}");
            self.counters.set_detail(described);
        }
        if std::mem::take(&mut self.is_video_guessed) && !self.source.decodes_video() {
            tracing::warn!(
                "no video is decoded here, but covariances are those of video, three times as large. Cure: \
                 fusion.coding: images, or video where the pictures were video before they came here"
            );
        }
    }

    /// Copies the luma plane from the decoder's buffer into shared memory: the one copy there is.
    fn send(&mut self, picture: &Picture) -> anyhow::Result<()> {
        let begun_ns = clock::monotonic_ns();
        self.counters.set_state(None);
        if !std::mem::replace(&mut self.has_begun, true) {
            self.tell_of_decoder();
        }
        let (width, height) = (picture.width(), picture.height());
        let mut loan = self.frames.loan(width as usize * height as usize)?;
        let rows = loan.items_mut().chunks_exact_mut(width as usize);
        for (target, y) in rows.zip(0..height) {
            target.copy_from_slice(picture.row(y));
        }
        let published_ns = clock::monotonic_ns();
        let Stamped { stamp, dropped } = self.core.on_picture(picture.time(), published_ns);
        self.counters.add_dropped(dropped);
        if let Some(inertial) = &mut self.inertial {
            inertial.send_before(picture, &stamp)?;
        }
        let recorded = picture.recorded().map(|recorded| &recorded.header);
        loan.send(FrameHeader {
            stamp,
            exposure_time_ns: recorded.map_or(0, |header| header.exposure_time_ns),
            readout_ns: recorded.map_or(self.readout_ns, |header| header.readout_ns),
            width,
            height,
            stride: width,
            pixel_format: PixelFormat::Gray8.code(),
            transfer: self.transfer.0.code(),
            gamma: self.transfer.1,
            range: picture.range().code(),
            projection: self.projection.code(),
        })?;
        self.counters.add_latency_ns(published_ns - begun_ns);
        self.credits.note_sent(stamp);
        Ok(())
    }
}
