//! `flockeye trace`: frames' paths through all processes of a running pipeline, as a file that
//! Perfetto (ui.perfetto.dev) and Chrome's `about:tracing` open.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use flockeye_cli::running::{PipelineChoice, attach};
use flockeye_cli::{Screen, signals};
use flockeye_config::Flow;
use flockeye_contract::{Detections, FrameEnds, Healths, Tracks};

use crate::trace_events::Tracer;

pub(crate) fn run(running: &PipelineChoice, out: &Path, duration: Duration) -> anyhow::Result<()> {
    let stopping = signals::stop_flag()?;
    let (instance, resolved, mut ports) = attach(running)?;
    // The file is created first, so that an unwritable one is reported before the recording.
    let cannot_write = || format!("cannot write {}", out.display());
    let file = File::create(out).with_context(cannot_write)?;
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
            || start.elapsed() >= duration
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
    let mut writer = BufWriter::new(file);
    serde_json::to_writer(&mut writer, &tracer.finish())
        .map_err(std::io::Error::from)
        .and_then(|()| writer.flush())
        .with_context(cannot_write)?;
    Screen::new()
        .line(&format!("{frames} frames are in {}: open it in ui.perfetto.dev", out.display()));
    Ok(())
}
