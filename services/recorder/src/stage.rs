//! The two threads of the recorder: one receives, the other writes.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow};
use flockeye_cli::{Screen, running, signals};
use flockeye_config::{Coding, Flow, Resolved};
use flockeye_contract::{CONTRACT_VERSION, PacketHeader, TOPICS, TopicId, Track, TrackState};
use flockeye_recording::losses::Loss;
use flockeye_recording::{About, RecordingError};
use flockeye_runtime::instance::Instance;
use flockeye_runtime::logs::Throttle;
use flockeye_runtime::memory::Budget;
use flockeye_runtime::recorders::Presence;
use flockeye_runtime::{clock, onlooker};
use iceoryx2::prelude::{LogLevel, set_log_level};
use rustix::process::setpriority_process;
use rustix::thread::gettid;
use signal_hook::consts::{SIGUSR1, SIGXFSZ};

use crate::arguments::{FramesChoice, RecordArguments, Trigger};
use crate::core::Core;
use crate::entry::Entry;
use crate::files::Files;
use crate::inputs::{Inputs, NotCoded};
use crate::queue::{Queue, Taken};
use crate::ring::Ring;

/// Bytes that wait for the disk at most.
const QUEUE_BYTES: usize = 128_000_000;
/// How often messages are received. A recorder that each of them wakes takes more of a processor, and so do the stages
/// that wake it. Fewer views come in this time than their topic's buffer holds.
const POLL: Duration = Duration::from_millis(2);
/// What was received is on the disk so soon, at the latest.
const FLUSH: Duration = Duration::from_secs(1);
/// The writing thread gives way to the stages.
const WRITER_NICE: i32 = 10;

/// Records until the time is over, the pipeline ends or a signal comes.
///
/// # Errors
/// No such pipeline runs, a file cannot be written, or the disk is full.
pub fn record(arguments: &RecordArguments, out: &Path) -> anyhow::Result<()> {
    let stopping = signals::stop_flag()?;
    let asked = Arc::new(AtomicBool::new(false));
    signal_hook::flag::register(SIGUSR1, asked.clone()).context("cannot catch signals")?;
    // A file that may not grow further is an error of its write, and does not end the process.
    signal_hook::flag::register(SIGXFSZ, Arc::default()).context("cannot catch signals")?;
    set_log_level(LogLevel::Fatal);
    let instance = running::choose(&arguments.running)?;
    let (ports, resolved) = onlooker::join(&instance)?;
    let mut ports = ports.polled();
    refuse_camera_without_video(arguments.frames, &resolved)?;
    let mut inputs = Inputs::open(&mut ports, &Budget::of(&resolved), arguments.frames)?;
    let (about, core) = beginning(&instance, &resolved)?;
    let mut files = Files::new(out, about, arguments.split);
    let ring = arguments.trigger.map(|trigger| (trigger, Ring::new(arguments.past)));
    if ring.is_none() {
        files.begin()?;
    }
    let queue = Queue::new(QUEUE_BYTES, TOPICS.len());
    let (told, left_out) = (Vec::new(), Throttle::default());
    let writing = Writing { queue: queue.clone(), core, files, ring, told, left_out };
    let thread = std::thread::Builder::new()
        .name("writer".to_owned())
        .spawn(move || writing.run())
        .context("a thread that writes")?;
    let presence = Presence::announce(&instance, arguments.trigger.is_some(), out)
        .context("the instance's folder")?;
    let start = Instant::now();
    let received = ports.attend(|| {
        inputs.drain(&queue)?;
        if asked.swap(false, Ordering::Relaxed) {
            queue.ask();
        }
        let is_over = stopping.load(Ordering::Relaxed)
            || arguments.duration.is_some_and(|duration| start.elapsed() >= duration)
            || queue.is_closed()
            || !instance.is_running();
        Ok((!is_over).then_some(POLL))
    });
    // What came between the last look and the end.
    let received = received.and_then(|()| {
        while !inputs.drain(&queue)? && !queue.is_closed() {
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

/// Refuses to record a camera's own video where it is known beforehand that there is none.
fn refuse_camera_without_video(frames: FramesChoice, resolved: &Resolved) -> anyhow::Result<()> {
    let source = &resolved.pipeline.source;
    match frames == FramesChoice::Camera && !source.may_send_packets() {
        true => Err(NotCoded).with_context(|| format!("source {}", source.input)),
        false => Ok(()),
    }
}

/// What the recording says of itself, and what makes it.
fn beginning(instance: &Instance, resolved: &Resolved) -> anyhow::Result<(About, Core)> {
    let pipeline = &resolved.pipeline;
    let path = instance.folder().join("pipeline.json");
    let json = std::fs::read(&path).with_context(|| path.display().to_string())?;
    let mut parsed: serde_json::Value =
        serde_json::from_slice(&json).with_context(|| path.display().to_string())?;
    // What `auto` is depends on files that may not be there when the recording is replayed.
    let coding = if pipeline.is_coded_as_video() { Coding::Video } else { Coding::Images };
    parsed["fusion"]["coding"] = serde_json::to_value(coding)?;
    let bodies = serde_json::to_vec(&parsed["resolved"]["bodies"])?;
    let utc_from_monotonic_ns = clock::utc_ns() - clock::monotonic_ns();
    let (flow, utc_from_exposure_ns) = match pipeline.flow() {
        Flow::Latest => ("latest", utc_from_monotonic_ns),
        // Exposure times are the stream's: it begins now.
        Flow::Lossless => ("lossless", clock::utc_ns()),
    };
    let said = [
        ("format", "1"),
        ("contract", CONTRACT_VERSION),
        ("version", env!("CARGO_PKG_VERSION")),
        ("instance", instance.name()),
        ("observer", &pipeline.observer.name),
        ("swarm", &pipeline.observer.swarm),
        ("flow", flow),
        ("utc_from_exposure_ns", &utc_from_exposure_ns.to_string()),
    ];
    let json_type = "application/json".to_owned();
    let about = About {
        utc_from_monotonic_ns,
        metadata: said.map(|(name, value)| (name.to_owned(), value.to_owned())).into(),
        attachments: vec![
            ("pipeline.json".to_owned(), json_type.clone(), serde_json::to_vec(&parsed)?),
            ("bodies.json".to_owned(), json_type, bodies),
        ],
    };
    Ok((about, Core::new(&pipeline.observer.name, utc_from_exposure_ns)))
}

/// The thread that writes.
struct Writing {
    queue: Queue,
    core: Core,
    files: Files,
    ring: Option<(Trigger, Ring)>,
    /// The losses that were written last.
    told: Vec<Loss>,
    left_out: Throttle,
}

impl Writing {
    /// Writes until nothing comes any more. Returns what is to be said of it.
    fn run(mut self) -> anyhow::Result<String> {
        if let Err(error) = setpriority_process(Some(gettid()), WRITER_NICE) {
            tracing::debug!("the thread that writes does not give way: {error}");
        }
        let outcome = self.write_all();
        // Whatever it was: nobody takes any more, so the other thread ends too.
        self.queue.close();
        match outcome {
            Ok(()) => {}
            // There is room for the index.
            Err(error) if matches!(error.downcast_ref(), Some(RecordingError::DiskFull { .. })) => {
                self.files.end()?;
                return Err(error);
            }
            Err(error) => return Err(error),
        }
        let (files, messages, bytes) = self.files.written();
        let megabytes = bytes as f64 / 1e6;
        let lacking = self.queue.losses().iter().filter(|loss| loss.lost() > 0).count();
        let lack = match lacking {
            0 => "nothing is missing".to_owned(),
            topics => {
                format!("of {topics} topics something may be missing: {}", crate::core::LOSSES)
            }
        };
        Ok(format!("{messages} messages are in {files} files of {megabytes:.1} MB; {lack}"))
    }

    fn write_all(&mut self) -> anyhow::Result<()> {
        let mut warnings = Throttle::default();
        let mut flush_at = Instant::now() + FLUSH;
        loop {
            let is_asked = match self.queue.take(flush_at) {
                Taken::Entry(entry) => self.on(entry)?,
                Taken::Nothing => false,
                Taken::End => break,
            };
            if is_asked || self.queue.take_request() {
                self.write_ring()?;
            }
            if Instant::now() >= flush_at {
                self.write_losses(&mut warnings)?;
                self.files.flush()?;
                flush_at = Instant::now() + FLUSH;
            }
        }
        self.write_losses(&mut warnings)?;
        self.files.end()?;
        Ok(())
    }

    /// Takes a message. Whether the ring is to be written because of it.
    fn on(&mut self, entry: Entry) -> anyhow::Result<bool> {
        let Some((trigger, ring)) = &mut self.ring else {
            self.write(&entry)?;
            return Ok(false);
        };
        let is_asked = *trigger == Trigger::Lost && loses_somebody(&entry);
        ring.push(entry);
        Ok(is_asked)
    }

    fn write(&mut self, entry: &Entry) -> anyhow::Result<()> {
        let outputs = match self.core.on(entry) {
            Ok(outputs) => outputs,
            Err(error) => {
                self.leave_out(entry.topic, &error);
                return Ok(());
            }
        };
        // A header and its pixels stand in one file.
        self.files.split_if_full()?;
        for output in outputs {
            match self.files.write(entry.at_ns, &output) {
                Err(error @ RecordingError::Message { .. }) => {
                    self.leave_out(entry.topic, &error.into())
                }
                other => other?,
            }
        }
        Ok(())
    }

    /// One message that cannot be recorded does not end the recording.
    fn leave_out(&mut self, topic: usize, error: &anyhow::Error) {
        self.queue.note(topic, |loss| {
            loss.recorded = loss.recorded.saturating_sub(1);
            loss.refused += 1;
        });
        if let Some(more_since) = self.left_out.admit() {
            tracing::warn!(more_since, "a message is not recorded: {error:#}");
        }
    }

    fn write_ring(&mut self) -> anyhow::Result<()> {
        let Some((_, ring)) = &mut self.ring else { return Ok(()) };
        let entries = ring.take();
        let Some(last) = entries.back() else { return Ok(()) };
        let path = self.files.begin_dated(self.files.utc_ns(last.at_ns))?;
        // The oldest packets that are left may rest on one that is not.
        let mut has_key = false;
        for entry in &entries {
            if TOPICS[entry.topic].id == TopicId::Packets {
                has_key |= begins_video(entry);
                if !has_key {
                    continue;
                }
            }
            self.write(entry)?;
        }
        self.told.clear();
        self.write_losses(&mut Throttle::default())?;
        self.files.end()?;
        tracing::info!("what came before is in {}", path.display());
        Ok(())
    }

    /// Writes and says what was lost since the last time.
    fn write_losses(&mut self, warnings: &mut Throttle) -> anyhow::Result<()> {
        let losses = self.queue.losses();
        for (topic, loss) in losses.iter().enumerate() {
            let before = self.told.get(topic).copied().unwrap_or_default();
            let is_news = Loss { recorded: 0, ..before } != Loss { recorded: 0, ..*loss };
            if !is_news {
                continue;
            }
            self.files.write(clock::monotonic_ns(), &self.core.loss(topic, loss))?;
            let is_certain = loss.certain() > before.certain();
            let topic = TOPICS[topic].name;
            if is_certain && let Some(more_since) = warnings.admit() {
                let Loss { refused, missing, queue_full, .. } = loss;
                tracing::warn!(
                    topic,
                    more_since,
                    "messages are missing: {queue_full} found no room because the disk is too slow, {missing} \
                     numbers were left out, {refused} broke the contract. Cure: record less (--frames), or to a \
                     faster disk"
                );
            } else if !is_certain && before.buffer_full == 0 {
                // It comes again with every burst, and the file counts it.
                tracing::warn!(
                    topic,
                    "messages may be missing: as many came at once as find room. Cure: end what else keeps the \
                     processors busy"
                );
            }
        }
        self.told = losses;
        Ok(())
    }
}

/// Whether decoding can begin with a packet.
fn begins_video(entry: &Entry) -> bool {
    let header: PacketHeader = bytemuck::pod_read_unaligned(&entry.message.header);
    header.is_key == 1
}

/// Whether a message says that a neighbour's track is lost.
fn loses_somebody(entry: &Entry) -> bool {
    let mut tracks = entry.message.items.chunks_exact(size_of::<Track>());
    TOPICS[entry.topic].id == TopicId::Tracks
        && tracks.any(|bytes| {
            let track: Track = bytemuck::pod_read_unaligned(bytes);
            track.state == TrackState::Lost.code()
        })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use bytemuck::Zeroable;
    use flockeye_recording::ContractMessage;

    #[test]
    fn only_a_lost_track_is_one() {
        let entry = |id: TopicId, state: TrackState| {
            let track = Track { state: state.code(), ..Track::zeroed() };
            let items = bytemuck::bytes_of(&[Track::zeroed(), track]).to_vec();
            let topic = TOPICS.iter().position(|topic| topic.id == id).unwrap();
            let message = ContractMessage { items, ..ContractMessage::default() };
            Entry { topic, at_ns: 0, message, pixels: None }
        };
        assert!(loses_somebody(&entry(TopicId::Tracks, TrackState::Lost)));
        assert!(!loses_somebody(&entry(TopicId::Tracks, TrackState::Coasting)));
        assert!(!loses_somebody(&entry(TopicId::Plans, TrackState::Lost)));
    }
}
