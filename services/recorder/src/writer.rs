//! The writing thread: encodes the messages and fills the files.

use std::time::{Duration, Instant};

use flockeye_contract::{TOPICS, TopicId};
use flockeye_recording::RecordingError;
use flockeye_recording::channel::LOSSES;
use flockeye_runtime::clock;
use flockeye_runtime::logs::Throttle;
use rustix::process::setpriority_process;
use rustix::thread::gettid;

use crate::arguments::Trigger;
use crate::core::Core;
use crate::files::Files;
use crate::loss_reports::LossReports;
use crate::message::TopicMessage;
use crate::queue::{Taken, WriteQueue};
use crate::ring::Ring;

/// Maximum time from reception to disk.
const FLUSH: Duration = Duration::from_secs(1);
/// Nice value of the writing thread: lower priority than the stages.
const WRITER_NICE: i32 = 10;

pub(crate) struct DiskWriter {
    queue: WriteQueue,
    core: Core,
    files: Files,
    ring: Option<(Trigger, Ring)>,
    losses: LossReports,
    left_out: Throttle,
}

impl DiskWriter {
    /// A writer from `queue` to `files`; with a ring, only after a trigger.
    pub(crate) fn new(
        queue: WriteQueue,
        core: Core,
        files: Files,
        ring: Option<(Trigger, Ring)>,
    ) -> Self {
        let (losses, left_out) = (LossReports::default(), Throttle::default());
        Self { queue, core, files, ring, losses, left_out }
    }

    /// Writes until the queue is closed. Returns a summary for people.
    pub(crate) fn run(mut self) -> anyhow::Result<String> {
        if let Err(error) = setpriority_process(Some(gettid()), WRITER_NICE) {
            tracing::debug!("the thread that writes does not give way: {error}");
        }
        let outcome = self.write_all();
        // Close the queue after any outcome, so that the other thread ends too.
        self.queue.close();
        match outcome {
            Ok(()) => {}
            // The disk has room for the index.
            Err(error) if matches!(error.downcast_ref(), Some(RecordingError::DiskFull { .. })) => {
                self.files.end()?;
                return Err(error);
            }
            Err(error) => return Err(error),
        }
        let Files { count: files, messages, bytes, .. } = self.files;
        let megabytes = bytes as f64 / 1e6;
        let lacking = self.queue.losses().iter().filter(|loss| loss.lost() > 0).count();
        let lack = match lacking {
            0 => "nothing is missing".to_owned(),
            topics => format!("of {topics} topics something may be missing: {LOSSES}"),
        };
        Ok(format!("{messages} messages are in {files} files of {megabytes:.1} MB; {lack}"))
    }

    fn write_all(&mut self) -> anyhow::Result<()> {
        let mut flush_at = Instant::now() + FLUSH;
        loop {
            let is_asked = match self.queue.take(flush_at) {
                Taken::Message(entry) => self.on(entry)?,
                Taken::Nothing => false,
                Taken::End => break,
            };
            if is_asked || self.queue.take_request() {
                self.write_ring()?;
            }
            if Instant::now() >= flush_at {
                self.write_losses()?;
                self.files.flush()?;
                flush_at = Instant::now() + FLUSH;
            }
        }
        self.write_losses()?;
        self.files.end()?;
        Ok(())
    }

    /// Takes a message. Returns whether it triggers the ring.
    fn on(&mut self, entry: TopicMessage) -> anyhow::Result<bool> {
        let Some((trigger, ring)) = &mut self.ring else {
            self.write(&entry)?;
            return Ok(false);
        };
        let is_asked = *trigger == Trigger::Lost && entry.loses_somebody();
        ring.push(entry);
        Ok(is_asked)
    }

    fn write(&mut self, entry: &TopicMessage) -> anyhow::Result<()> {
        let outputs = match self.core.on(entry) {
            Ok(outputs) => outputs,
            Err(error) => {
                self.leave_out(entry.topic, &error);
                return Ok(());
            }
        };
        // Splits are between messages, so a header and its pixels are in one file.
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

    /// Counts a message that cannot be recorded; the recording continues.
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
        // Skip packets before the first key frame: they refer to removed packets.
        let mut has_key = false;
        for entry in &entries {
            if TOPICS[entry.topic].id == TopicId::Packets {
                has_key |= entry.begins_video();
                if !has_key {
                    continue;
                }
            }
            self.write(entry)?;
        }
        // Each file states all losses.
        self.losses = LossReports::default();
        self.write_losses()?;
        self.files.end()?;
        tracing::info!("what came before is in {}", path.display());
        Ok(())
    }

    /// Writes and logs the losses since the last call.
    fn write_losses(&mut self) -> anyhow::Result<()> {
        for (topic, loss) in self.losses.news(self.queue.losses()) {
            self.files.write(clock::monotonic_ns(), &self.core.loss(topic, &loss))?;
        }
        Ok(())
    }
}
