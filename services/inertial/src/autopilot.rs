//! The connection to an autopilot: on a thread of its own, because reading blocks.

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

/// How often the thread looks whether it shall stop while the line is not there.
const LOOK: Duration = Duration::from_millis(100);

/// Time between two of our heartbeats, without which routers send nothing.
const HEARTBEAT_PERIOD: Duration = Duration::from_secs(1);

/// Time without samples after which they are asked for again.
const ASK_PERIOD: Duration = Duration::from_secs(2);

/// Time between two attempts to open a line that is not there.
const REOPEN_PERIOD: Duration = Duration::from_secs(1);

/// Rate at which samples are asked for.
const SAMPLES_HZ: f64 = 200.0;

/// Our component: that of an onboard computer.
const ONBOARD_COMPUTER: u8 = 191;

/// News that wait for the stage: seconds of samples.
const NEWS: usize = 4096;

/// What comes over the connection.
#[derive(Debug)]
pub enum News {
    /// The line is open.
    Opened,
    /// The line is not there, or has gone; it is tried again.
    Lost {
        /// Why.
        reason: String,
    },
    /// A sample.
    Sample {
        /// Who sent it.
        sender: Sender,
        /// The sample.
        sample: AutopilotSample,
        /// When it arrived, CLOCK_MONOTONIC, nanoseconds.
        arrived_ns: i64,
    },
}

/// The thread that reads. Dropping it stops it.
#[derive(Debug)]
pub struct SampleReceiver {
    news: Receiver<News>,
    stopping: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl SampleReceiver {
    /// Begins to listen.
    ///
    /// # Errors
    /// The system gives no thread.
    pub fn listen(address: MavlinkAddress) -> std::io::Result<Self> {
        let (sender, news) = sync_channel(NEWS);
        let stopping = Arc::new(AtomicBool::new(false));
        let line = Line { address, news: sender, stopping: stopping.clone() };
        let thread = Builder::new().name("mavlink".into()).spawn(move || line.run())?;
        Ok(Self { news, stopping, thread: Some(thread) })
    }

    /// The next news, if any comes within `timeout`.
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

/// What the thread works with.
struct Line {
    address: MavlinkAddress,
    news: SyncSender<News>,
    stopping: Arc<AtomicBool>,
}

impl Line {
    fn run(&self) {
        while !self.is_stopping() {
            match link::open(&self.address) {
                Ok((reader, writer)) => {
                    self.tell(News::Opened);
                    if let Err(error) = self.listen(reader, writer) {
                        self.tell(News::Lost { reason: error.to_string() });
                    }
                }
                Err(error) => self.tell(News::Lost { reason: error.to_string() }),
            }
            let closed = Instant::now();
            while !self.is_stopping() && closed.elapsed() < REOPEN_PERIOD {
                std::thread::sleep(LOOK);
            }
        }
    }

    fn is_stopping(&self) -> bool {
        self.stopping.load(Ordering::Relaxed)
    }

    /// News that do not fit are dropped: the stage is busy, and the next sample is newer.
    fn tell(&self, news: News) {
        let _ = self.news.try_send(news);
    }

    /// Reads until the line is lost, or the thread shall stop.
    fn listen(&self, mut reader: LineReader, mut writer: LineWriter) -> std::io::Result<()> {
        let mut dialogue = Dialogue::default();
        while !self.is_stopping() {
            reader.read(&mut |header, message| {
                let arrived_ns = clock::monotonic_ns();
                let sender = (header.system_id, header.component_id);
                dialogue.hear(sender, message);
                if let Some(sample) = sample(message) {
                    self.tell(News::Sample { sender, sample, arrived_ns });
                }
                header.component_id == AUTOPILOT
            })?;
            dialogue.speak(&mut writer);
        }
        Ok(())
    }
}

/// What is sent to the autopilot, and when.
#[derive(Debug, Default)]
struct Dialogue {
    system: Option<u8>,
    heartbeat: Option<Instant>,
    sampled: Option<Instant>,
    asked: Option<Instant>,
    /// The number of the next message.
    sequence: u8,
}

impl Dialogue {
    fn hear(&mut self, (system, component): Sender, message: &MavMessage) {
        if component == AUTOPILOT && self.system.is_none() {
            // Commands are addressed with eight bits.
            self.system = u8::try_from(system).ok();
        }
        if sample(message).is_some_and(|sample| sample.kind == MessageKind::HighresImu) {
            self.sampled = Some(Instant::now());
        }
    }

    /// Sends what is due. A line that cannot be written to can still be read, so nothing is made of
    /// errors: the autopilot may be set to send without being asked.
    fn speak(&mut self, writer: &mut LineWriter) {
        let is_due =
            |last: Option<Instant>, period| last.is_none_or(|last| last.elapsed() >= period);
        let Some(system_id) = self.system else { return };
        if is_due(self.heartbeat, HEARTBEAT_PERIOD) {
            self.heartbeat = Some(Instant::now());
            self.send(writer, system_id, &Outgoing::Heartbeat(heartbeat()));
        }
        if is_due(self.sampled, ASK_PERIOD) && is_due(self.asked, ASK_PERIOD) {
            self.asked = Some(Instant::now());
            // Both are asked for: autopilots that do not have one answer so, and send the other.
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
