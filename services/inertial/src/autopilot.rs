//! The connection to an autopilot, on a thread of its own because reading blocks.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::thread::{Builder, JoinHandle};
use std::time::{Duration, Instant};

use flockeye_autopilot::link::{self, LineReader, LineWriter};
use flockeye_autopilot::messages::{Outgoing, ask_for, heartbeat};
use flockeye_config::MavlinkAddress;
use flockeye_runtime::clock;
use mavlink::dialects::development::{ATTITUDE_QUATERNION_DATA, HIGHRES_IMU_DATA, MavMessage};
use mavlink::{MavHeader, MessageData};

use crate::core::{AUTOPILOT, Sender};
use crate::message::{AutopilotSample, MessageKind, sample};

/// Period at which the thread checks its stop flag while the line is closed.
const LOOK: Duration = Duration::from_millis(100);

/// Period of our heartbeats. Routers send nothing without them.
const HEARTBEAT_PERIOD: Duration = Duration::from_secs(1);

/// Time without samples after which they are requested again.
const ASK_PERIOD: Duration = Duration::from_secs(2);

/// Time between two attempts to open a closed line.
const REOPEN_PERIOD: Duration = Duration::from_secs(1);

/// Requested rate of the samples.
const SAMPLES_HZ: f64 = 200.0;

/// MAVLink component of this process: an onboard computer.
const ONBOARD_COMPUTER: u8 = 191;

/// Capacity of the queue to the stage: seconds of samples.
const NEWS: usize = 4096;

/// Event of the connection.
#[derive(Debug)]
pub enum News {
    /// The line is open.
    Opened,
    /// The line could not be opened or was lost; it is tried again.
    Lost {
        /// The reason.
        reason: String,
    },
    /// A sample.
    Sample {
        /// System and component that sent it.
        sender: Sender,
        /// The sample.
        sample: AutopilotSample,
        /// Time of arrival, CLOCK_MONOTONIC, nanoseconds.
        arrived_ns: i64,
    },
}

/// The thread that reads. It stops when this is dropped.
#[derive(Debug)]
pub struct SampleReceiver {
    news: Receiver<News>,
    stopping: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl SampleReceiver {
    /// Starts the thread.
    ///
    /// # Errors
    /// The system starts no thread.
    pub fn listen(address: MavlinkAddress) -> std::io::Result<Self> {
        let (sender, news) = sync_channel(NEWS);
        let stopping = Arc::new(AtomicBool::new(false));
        let is_stopping = stopping.clone();
        let thread = Builder::new()
            .name("mavlink".into())
            .spawn(move || run(&address, &sender, &is_stopping))?;
        Ok(Self { news, stopping, thread: Some(thread) })
    }

    /// Returns the next event, if one arrives within `timeout`.
    ///
    /// # Errors
    /// The thread has ended.
    pub fn next(&self, timeout: Duration) -> Result<Option<News>, std::io::Error> {
        match self.news.recv_timeout(timeout) {
            Ok(news) => Ok(Some(news)),
            Err(RecvTimeoutError::Timeout) => Ok(None),
            Err(RecvTimeoutError::Disconnected) => Err(std::io::Error::other(
                "the thread that reads has ended; its panic was said before",
            )),
        }
    }
}

impl Drop for SampleReceiver {
    fn drop(&mut self) {
        self.stopping.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::warn!("the thread that reads has panicked");
        }
    }
}

/// Opens the line and reads, again and again, until the stop flag is set.
fn run(address: &MavlinkAddress, news: &SyncSender<News>, stopping: &AtomicBool) {
    while !stopping.load(Ordering::Relaxed) {
        match link::open(address) {
            Ok((reader, writer)) => {
                publish(news, News::Opened);
                if let Err(error) = listen(reader, writer, news, stopping) {
                    publish(news, News::Lost { reason: error.to_string() });
                }
            }
            Err(error) => publish(news, News::Lost { reason: error.to_string() }),
        }
        let closed = Instant::now();
        while !stopping.load(Ordering::Relaxed) && closed.elapsed() < REOPEN_PERIOD {
            std::thread::sleep(LOOK);
        }
    }
}

/// Sends an event. If the queue is full, the event is dropped: the stage is busy, and the next
/// sample is newer.
fn publish(news: &SyncSender<News>, event: News) {
    let _ = news.try_send(event);
}

/// Reads until the line is lost or the stop flag is set.
fn listen(
    mut reader: LineReader,
    mut writer: LineWriter,
    news: &SyncSender<News>,
    stopping: &AtomicBool,
) -> std::io::Result<()> {
    let mut dialogue = Dialogue::default();
    while !stopping.load(Ordering::Relaxed) {
        reader.read(&mut |header, message| {
            let arrived_ns = clock::monotonic_ns();
            let sender = (header.system_id, header.component_id);
            dialogue.receive(sender, message);
            if let Some(sample) = sample(message) {
                publish(news, News::Sample { sender, sample, arrived_ns });
            }
            header.component_id == AUTOPILOT
        })?;
        dialogue.send_due(&mut writer);
    }
    Ok(())
}

/// Messages to the autopilot, with their times.
#[derive(Debug, Default)]
struct Dialogue {
    system: Option<u8>,
    heartbeat: Option<Instant>,
    sampled: Option<Instant>,
    asked: Option<Instant>,
    /// Sequence number of the next message.
    sequence: u8,
}

impl Dialogue {
    fn receive(&mut self, (system, component): Sender, message: &MavMessage) {
        if component == AUTOPILOT && self.system.is_none() {
            // Commands have eight bits for the address.
            self.system = u8::try_from(system).ok();
        }
        if sample(message).is_some_and(|sample| sample.kind == MessageKind::HighresImu) {
            self.sampled = Some(Instant::now());
        }
    }

    /// Sends the messages that are due. A line that cannot be written to can still be read, so
    /// errors are ignored. The autopilot may be configured to send without a request.
    fn send_due(&mut self, writer: &mut LineWriter) {
        let is_due =
            |last: Option<Instant>, period| last.is_none_or(|last| last.elapsed() >= period);
        let Some(system_id) = self.system else { return };
        if is_due(self.heartbeat, HEARTBEAT_PERIOD) {
            self.heartbeat = Some(Instant::now());
            self.send(writer, system_id, &Outgoing::Heartbeat(heartbeat()));
        }
        if is_due(self.sampled, ASK_PERIOD) && is_due(self.asked, ASK_PERIOD) {
            self.asked = Some(Instant::now());
            // Both are requested: an autopilot without one of them refuses it, and sends the other.
            for message in [HIGHRES_IMU_DATA::ID, ATTITUDE_QUATERNION_DATA::ID] {
                self.send(
                    writer,
                    system_id,
                    &Outgoing::Command(ask_for(system_id, message, SAMPLES_HZ)),
                );
            }
        }
    }

    fn send(&mut self, writer: &mut LineWriter, system_id: u8, message: &Outgoing) {
        let header = MavHeader {
            system_id: system_id.into(),
            component_id: ONBOARD_COMPUTER,
            sequence: self.sequence,
        };
        if matches!(writer.write(message.frame(header).raw_bytes()), Ok(true)) {
            self.sequence = self.sequence.wrapping_add(1);
        }
    }
}
