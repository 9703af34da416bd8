//! The receiving thread: moves messages from the ports to the queue.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow};
use flockeye_cli::{Screen, running, signals};
use flockeye_config::Resolved;
use flockeye_contract::TOPICS;
use flockeye_runtime::memory::Budget;
use flockeye_runtime::onlooker;
use flockeye_runtime::recorders::Presence;
use signal_hook::consts::{SIGUSR1, SIGXFSZ};

use crate::about::beginning;
use crate::arguments::{FramesChoice, RecordArguments};
use crate::files::Files;
use crate::inputs::{NotCoded, drain, open_lanes};
use crate::queue::WriteQueue;
use crate::ring::{MOST_BYTES, Ring};
use crate::writer::DiskWriter;

/// Limit for the size of the queue, bytes.
const QUEUE_BYTES: usize = 128_000_000;
/// Polling interval. A wake-up per message would need more processor time, here and in the stages.
/// The topics' buffers have room for the views of this time.
const POLL: Duration = Duration::from_millis(2);

/// Records until the time is over, the pipeline ends or a signal comes.
pub(crate) fn record(arguments: &RecordArguments, out: &Path) -> anyhow::Result<()> {
    let stopping = signals::stop_flag()?;
    let asked = Arc::new(AtomicBool::new(false));
    signal_hook::flag::register(SIGUSR1, asked.clone()).context("cannot catch signals")?;
    // Ignore SIGXFSZ: a file size limit is then an error of the write, and does not end the
    // process.
    signal_hook::flag::register(SIGXFSZ, Arc::default()).context("cannot catch signals")?;
    let instance = running::choose(&arguments.running)?;
    let (ports, resolved) = onlooker::join(&instance)?;
    let mut ports = ports.polled();
    refuse_camera_without_video(arguments.frames, &resolved)?;
    let mut lanes = open_lanes(&mut ports, &Budget::of(&resolved), arguments.frames)?;
    let (about, core) = beginning(&instance, &resolved)?;
    let mut files = Files::new(out, about, arguments.split);
    let ring = arguments.trigger.map(|trigger| (trigger, Ring::new(arguments.past, MOST_BYTES)));
    if ring.is_none() {
        files.begin()?;
    }
    let queue = WriteQueue::new(QUEUE_BYTES, TOPICS.len());
    let writer = DiskWriter::new(queue.clone(), core, files, ring);
    let thread = std::thread::Builder::new()
        .name("writer".to_owned())
        .spawn(move || writer.run())
        .context("a thread that writes")?;
    let presence = Presence::announce(&instance, arguments.trigger.is_some(), out)
        .context("the instance's folder")?;
    let start = Instant::now();
    let received = ports.attend(|| {
        drain(&mut lanes, &queue)?;
        if asked.swap(false, Ordering::Relaxed) {
            queue.ask();
        }
        let is_over = stopping.load(Ordering::Relaxed)
            || arguments.duration.is_some_and(|duration| start.elapsed() >= duration)
            || queue.is_closed()
            || !instance.is_running();
        Ok((!is_over).then_some(POLL))
    });
    // Receive the messages between the last poll and the end.
    let received = received.and_then(|()| {
        while !drain(&mut lanes, &queue)? && !queue.is_closed() {
            std::thread::sleep(POLL);
        }
        Ok(())
    });
    drop(presence);
    queue.close();
    let written = thread.join().map_err(|_| anyhow!("the thread that writes has panicked"))?;
    let summary = written?;
    received?;
    Screen::new().line(&summary);
    Ok(())
}

/// Refuses to record a camera's own video if the configured source has none.
fn refuse_camera_without_video(frames: FramesChoice, resolved: &Resolved) -> anyhow::Result<()> {
    let source = &resolved.pipeline.source;
    match frames == FramesChoice::Camera && !source.may_send_packets() {
        true => Err(NotCoded).with_context(|| format!("source {}", source.input)),
        false => Ok(()),
    }
}
