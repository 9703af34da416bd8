//! `flockeye trace`: frames' paths through all processes of a running pipeline, as a file that
//! Perfetto (ui.perfetto.dev) and Chrome's `about:tracing` open.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::PathBuf;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use clap::Args;
use flockeye_cli::running::{Attached, PipelineChoice, attach};
use flockeye_cli::{Screen, duration, signals};
use flockeye_config::Flow;
use flockeye_contract::{Detections, FrameEnds, Healths, Tracks};

use crate::trace_events::Tracer;

/// Arguments of `trace`.
#[derive(Debug, Args)]
pub(crate) struct TraceArguments {
    /// Which pipeline.
    #[command(flatten)]
    pub running: PipelineChoice,
    /// The trace, in Chrome's JSON format.
    #[arg(long, value_name = "FILE.json")]
    pub out: PathBuf,
    /// How long to record: 10s, 1m.
    #[arg(long = "for", value_name = "DURATION", value_parser = duration, default_value = "5s")]
    pub duration: Duration,
}

/// Records the trace.
///
/// # Errors
/// No such pipeline runs, no message came, or the file cannot be written.
pub(crate) fn run(arguments: &TraceArguments) -> anyhow::Result<()> {
    let stopping = signals::stop_flag()?;
    let Attached { mut ports, instance, resolved } = attach(&arguments.running)?;
    // First, so that an unwritable file is reported before the recording.
    let file = File::create(&arguments.out)
        .with_context(|| format!("cannot write {}", arguments.out.display()))?;
    let mut healths = ports.subscriber::<Healths>()?;
    let mut detections = ports.subscriber::<Detections>()?;
    let mut ends = ports.subscriber::<FrameEnds>()?;
    let mut tracks = ports.subscriber::<Tracks>()?;
    let mut tracer = Tracer::new(
        resolved.pipeline.source.stage().name(),
        resolved.pipeline.flow() == Flow::Latest,
    );
    let start = Instant::now();
    ports.attend(|| {
        while let Some(message) = healths.receive()? {
            tracer.health(&message.header);
        }
        while let Some(message) = detections.receive()? {
            tracer.detection(&message.header);
        }
        while let Some(message) = ends.receive()? {
            tracer.end(&message.header);
        }
        while let Some(message) = tracks.receive()? {
            tracer.tracks(&message.header, message.items());
        }
        let is_over = stopping.load(Ordering::Relaxed)
            || start.elapsed() >= arguments.duration
            || !instance.is_running();
        Ok((!is_over).then_some(Duration::from_millis(100)))
    })?;
    ensure!(
        tracer.frames() > 0,
        "no frame passed through the pipeline '{}' in {:.1} s. Cure: see what its stages do with `flockeye top`",
        instance.name(),
        start.elapsed().as_secs_f64()
    );
    let frames = tracer.frames();
    let mut out = BufWriter::new(file);
    serde_json::to_writer(&mut out, &tracer.finish())
        .map_err(std::io::Error::from)
        .and_then(|()| out.flush())
        .with_context(|| format!("cannot write {}", arguments.out.display()))?;
    Screen::new().line(&format!(
        "{frames} frames are in {}: open it in ui.perfetto.dev",
        arguments.out.display()
    ));
    Ok(())
}
