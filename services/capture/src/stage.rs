//! The ports around a source.

use std::time::Duration;

use flockeye_config::{AtEnd, Flow, Pipeline};
use flockeye_contract::{
    FrameHeader, FrameStamp, Frames, PixelFormat, Projection, StageState, Transfer,
};
use flockeye_convert::projection_of;
use flockeye_runtime::credits::Credits;
use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::logs::Throttle;
use flockeye_runtime::ports::{Ports, Publisher};
use flockeye_runtime::{Context, Stage, Step, clock};

use crate::{EndReason, Event, Paced, Picture, Source, SourceParameters, SourceSpec};

/// How long the source is waited for between two looks at everything else.
const WAIT: Duration = Duration::from_millis(50);

/// Takes nothing (in a lossless run: plans, as credits); gives frames.
pub struct CaptureStage {
    frames: Publisher<Frames>,
    credits: Credits,
    source: Source,
    stamps: Stamps,
    transfer: (Transfer, f32),
    projection: Projection,
    readout_ns: u64,
    has_ended: bool,
    counters: SharedCounters,
    losses: Throttle,
    skips: Throttle,
}

/// What the stamps of all frames share.
struct Stamps {
    flow: Flow,
    epoch: u32,
    generation: u32,
    next_sequence: u64,
}

impl Stage for CaptureStage {
    const NAME: &'static str = "capture";

    fn open(context: &Context, ports: &mut Ports) -> anyhow::Result<Self> {
        let pipeline = &context.pipeline;
        let spec: SourceSpec = pipeline.source.input.parse()?;
        let source = Source::open(spec, parameters(pipeline))?;
        tracing::info!("{}", source.describe());
        context.counters.set_detail(source.describe());
        Ok(Self {
            frames: ports.publisher()?,
            credits: Credits::open(pipeline, ports)?,
            source,
            stamps: Stamps {
                flow: pipeline.flow,
                epoch: 0,
                generation: context.identity.generation,
                next_sequence: 0,
            },
            transfer: pipeline.transfer(),
            projection: projection_of(&pipeline.camera_model()?),
            readout_ns: (pipeline.camera.readout_ms * 1e6) as u64,
            has_ended: false,
            counters: context.counters.clone(),
            losses: Throttle::default(),
            skips: Throttle::default(),
        })
    }

    fn step(&mut self) -> anyhow::Result<Step> {
        if !self.credits.may_send()? {
            return Ok(Step::WaitUntil(clock::monotonic_ns() + 100_000_000));
        }
        if self.has_ended {
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
            Event::Looped { after } => {
                tracing::debug!("{after}; it begins again");
                self.begin_epoch();
            }
            Event::Lost { reason, retry_in } => {
                self.counters.set_state(Some(StageState::Degraded));
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
                self.has_ended = true;
            }
        }
        Ok(Step::Again)
    }
}

impl CaptureStage {
    /// The source counts from 0 again.
    fn begin_epoch(&mut self) {
        self.stamps.epoch += 1;
        self.stamps.next_sequence = 0;
    }

    /// Copies the luma plane from the decoder's buffer into shared memory: the one copy there is.
    fn send(&mut self, picture: &Picture) -> anyhow::Result<()> {
        let begun_ns = clock::monotonic_ns();
        self.counters.set_state(None);
        let (width, height) = (picture.width(), picture.height());
        let mut loan = self.frames.loan(width as usize * height as usize)?;
        let rows = loan.items_mut().chunks_exact_mut(width as usize);
        for (target, y) in rows.zip(0..height) {
            target.copy_from_slice(picture.row(y));
        }
        let published_ns = clock::monotonic_ns();
        let stamp = self.stamps.of(picture, published_ns);
        self.counters.add_dropped(stamp.sequence.saturating_sub(self.stamps.next_sequence));
        self.stamps.next_sequence = stamp.sequence + 1;
        loan.send(FrameHeader {
            stamp,
            exposure_time_ns: 0,
            readout_ns: self.readout_ns,
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

impl Stamps {
    fn of(&self, picture: &Picture, published_ns: i64) -> FrameStamp {
        let stream_ns = i64::try_from(picture.stream_time().as_nanos()).unwrap_or(i64::MAX);
        FrameStamp {
            sequence: picture.sequence(),
            exposure_ns: match self.flow {
                Flow::Latest => picture.exposure_monotonic_ns(),
                Flow::Lossless => stream_ns,
            },
            stream_ns,
            published_ns,
            epoch: self.epoch,
            source_generation: self.generation,
        }
    }
}

fn parameters(pipeline: &Pipeline) -> SourceParameters {
    let seconds = |s: f64| Duration::try_from_secs_f64(s).unwrap_or(Duration::from_secs(1));
    SourceParameters {
        flow: match pipeline.flow {
            Flow::Latest => Paced::RealTime,
            Flow::Lossless => Paced::Lossless,
        },
        looping: pipeline.source.at_end == AtEnd::Loop,
        latency: seconds(pipeline.camera.latency_ms * 1e-3),
        reopen_min: seconds(pipeline.source.reopen_s[0]),
        reopen_max: seconds(pipeline.source.reopen_s[1]),
        images_per_second: pipeline.source.images_per_second,
        decoder_threads: pipeline.source.decoder_threads,
        ..SourceParameters::new(pipeline.camera.width, pipeline.camera.height)
    }
}
