//! `flockeye trace`: frames' ways through all processes of a running pipeline, as a file that
//! Perfetto (ui.perfetto.dev) and Chrome's `about:tracing` open.

mod event;

use std::fs::File;
use std::io::{BufWriter, Write};
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use flockeye_config::Flow;
use flockeye_contract::{Detections, FrameEnds, Healths, Tracks};

use crate::attach::{Attached, attach};
use crate::cli;
use crate::screen::Screen;
use crate::up::stopped_by_signals;
pub use event::Tracer;

/// Records it.
///
/// # Errors
/// No such pipeline runs, nothing was heard, or the file cannot be written.
pub fn run(arguments: &cli::Trace) -> anyhow::Result<()> {
    let stopping = stopped_by_signals()?;
    let Attached { mut ports, instance, resolved } = attach(&arguments.running)?;
    // Before anything is recorded, so that nothing is recorded in vain.
    let file = File::create(&arguments.out)
        .with_context(|| format!("cannot write {}", arguments.out.display()))?;
    let mut healths = ports.subscriber::<Healths>()?;
    let mut detections = ports.subscriber::<Detections>()?;
    let mut ends = ports.subscriber::<FrameEnds>()?;
    let mut tracks = ports.subscriber::<Tracks>()?;
    let mut tracer = Tracer::new(
        resolved.pipeline.source_stage().name(),
        resolved.pipeline.flow == Flow::Latest,
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
        "nothing came through the pipeline '{}' in {:.1} s: `flockeye top` says what its stages do",
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
