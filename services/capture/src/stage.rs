//! The capture stage: moves pictures from a source to the port.

use std::time::Duration;

use flockeye_config::Pipeline;
use flockeye_contract::Frames;
use flockeye_runtime::credits::Credits;
use flockeye_runtime::findings::Finding;
use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::ports::{Ports, Publisher};
use flockeye_runtime::{Context, Stage, Step, clock};

use crate::core::Core;
use crate::examine;
use crate::inertial::InertialPort;
use crate::packet_port::PacketPort;
use crate::source_reports::SourceReports;
use crate::{Event, FrameSource, SourceParameters, SourcePicture, SourceSpec};

/// Timeout of one wait for the source.
const WAIT: Duration = Duration::from_millis(50);

/// Inputs: none, or plans as credits in a lossless run. Outputs: frames, inertial samples of a
/// recording, and coded pictures if subscribed.
pub(crate) struct CaptureStage {
    frames: Publisher<Frames>,
    inertial: Option<InertialPort>,
    packets: PacketPort,
    credits: Credits,
    source: FrameSource,
    core: Core,
    reports: SourceReports,
    counters: SharedCounters,
}

impl Stage for CaptureStage {
    const NAME: &'static str = "capture";

    fn open(context: &Context, ports: &mut Ports) -> anyhow::Result<Self> {
        let (resolved, generation) = (&context.resolved, context.identity.generation);
        let pipeline = &resolved.pipeline;
        let spec: SourceSpec = pipeline.source.input.parse()?;
        let parameters = SourceParameters::of(pipeline);
        // Opened before the source, so that a recorder receives the first packet.
        let packets = PacketPort::open(pipeline, generation, parameters.packets.clone(), ports)?;
        let source = FrameSource::open(spec, parameters)?;
        Ok(Self {
            frames: ports.publisher()?,
            inertial: InertialPort::open(pipeline, generation, ports)?,
            packets,
            credits: Credits::open(pipeline, ports)?,
            reports: SourceReports::new(pipeline, &source, context.counters.clone()),
            source,
            core: Core::of(resolved, generation),
            counters: context.counters.clone(),
        })
    }

    fn examine(pipeline: &Pipeline) -> Vec<Finding> {
        examine::examine(pipeline)
    }

    fn step(&mut self) -> anyhow::Result<Step> {
        self.packets.attend(&self.source, self.core.epoch())?;
        if !self.credits.may_send()? {
            return Ok(Step::WaitUntil(Credits::retry_ns()));
        }
        if self.core.has_ended() {
            return Ok(Step::Finished);
        }
        match self.source.next(WAIT)? {
            Event::Frame(picture) => self.send(&picture)?,
            Event::Idle => {}
            Event::Skipped { what, why } => self.reports.skipped(&what, &why),
            Event::NewEpoch => {
                tracing::info!("the recorded source begins anew");
                self.begin_epoch();
            }
            Event::Looped { after } => {
                tracing::debug!("{after}; it begins again");
                self.begin_epoch();
            }
            Event::Late { what } => self.reports.late(&what, &self.source),
            Event::Lost { reason, retry_in } => {
                self.reports.lost(&reason, retry_in);
                self.begin_epoch();
            }
            Event::End(reason) => {
                self.reports.ended(&reason);
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

    /// Copies the luma plane from the decoder's buffer to shared memory: the only copy.
    fn send(&mut self, picture: &SourcePicture) -> anyhow::Result<()> {
        let begun_ns = clock::monotonic_ns();
        self.reports.frame(&self.source);
        let (width, height) = (picture.width(), picture.height());
        let mut loan = self.frames.loan(width as usize * height as usize)?;
        let rows = loan.items_mut().chunks_exact_mut(width as usize);
        for (target, y) in rows.zip(0..height) {
            target.copy_from_slice(picture.row(y));
        }
        let published_ns = clock::monotonic_ns();
        let (header, dropped) = self.core.on_picture(&picture.facts(), published_ns);
        self.counters.add_dropped(dropped);
        if let Some(inertial) = &mut self.inertial {
            inertial.send_before(picture, &header.stamp)?;
        }
        self.frames.send_loan(loan, header)?;
        self.counters.add_latency_ns(published_ns - begun_ns);
        self.credits.note_sent(header.stamp);
        Ok(())
    }
}
