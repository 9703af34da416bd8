//! The connection to an autopilot: on a thread of its own, because reading blocks.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::thread::{Builder, JoinHandle};
use std::time::{Duration, Instant};

use flockeye_config::MavlinkAddress;
use flockeye_runtime::clock;
use mavlink::dialects::common::{
    COMMAND_LONG_DATA, HEARTBEAT_DATA, MavAutopilot, MavCmd, MavMessage, MavModeFlag, MavState,
    MavType,
};
use mavlink::error::MessageReadError;
use mavlink::{
    Connectable, Connection, MavConnection, MavHeader, MessageData, SerialConfig, UdpConfig,
    UdpMode,
};

use crate::core::{AUTOPILOT, Sender};
use crate::message::{AutopilotSample, MessageKind, sample};

/// The longest that a read blocks: so soon the thread sees that it shall stop.
const READ_TIMEOUT: Duration = Duration::from_millis(100);

/// Between two of our heartbeats, which routers want to hear before they send.
const HEARTBEAT_PERIOD: Duration = Duration::from_secs(1);

/// Without samples for so long, they are asked for again.
const ASK_PERIOD: Duration = Duration::from_secs(2);

/// Between two attempts to open a line that is not there.
const REOPEN_PERIOD: Duration = Duration::from_secs(1);

/// Samples are asked for so often, microseconds: 200 a second.
const SAMPLE_INTERVAL_US: f32 = 5000.0;

/// Our component: that of an onboard computer.
const ONBOARD_COMPUTER: u8 = 191;

/// News that wait for the stage: seconds of samples.
const NEWS: usize = 4096;

/// What the connection has to say.
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
        /// What it says.
        sample: AutopilotSample,
        /// When it arrived, CLOCK_MONOTONIC, nanoseconds.
        arrived_ns: i64,
    },
}

/// The thread that reads. Dropping it stops it.
#[derive(Debug)]
pub struct Autopilot {
    news: Receiver<News>,
    stopping: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Autopilot {
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

impl Drop for Autopilot {
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
            match self.open() {
                Ok(connection) => {
                    self.tell(News::Opened);
                    let reason = self.listen(&connection);
                    if let Some(reason) = reason {
                        self.tell(News::Lost { reason });
                    }
                }
                Err(error) => self.tell(News::Lost { reason: error.to_string() }),
            }
            let closed = Instant::now();
            while !self.is_stopping() && closed.elapsed() < REOPEN_PERIOD {
                std::thread::sleep(READ_TIMEOUT);
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

    fn open(&self) -> std::io::Result<Connection<MavMessage>> {
        match &self.address {
            MavlinkAddress::Udp(address) => {
                UdpConfig::new(address.clone(), UdpMode::Udpin).read_timeout(READ_TIMEOUT).connect()
            }
            MavlinkAddress::Serial { device, baud } => {
                SerialConfig::new(device.clone(), *baud).timeout(READ_TIMEOUT).connect()
            }
        }
    }

    /// Reads until the line is lost, and says why; `None` where the thread shall stop.
    fn listen(&self, connection: &Connection<MavMessage>) -> Option<String> {
        let mut dialogue = Dialogue::default();
        while !self.is_stopping() {
            let read = match self.address {
                MavlinkAddress::Udp(_) => connection.recv(),
                // `recv` would try a line that is gone again and again, without end.
                MavlinkAddress::Serial { .. } => connection.try_recv(),
            };
            match read {
                Ok((header, message)) => {
                    let arrived_ns = clock::monotonic_ns();
                    let sender = (header.system_id, header.component_id);
                    dialogue.hear(sender, &message);
                    if let Some(sample) = sample(&message) {
                        self.tell(News::Sample { sender, sample, arrived_ns });
                    }
                }
                // Noise on the line, and messages of dialects that are not ours.
                Err(MessageReadError::Parse(_)) => {}
                Err(MessageReadError::Io(error)) if is_timeout(&error) => {}
                Err(MessageReadError::Io(error)) => return Some(error.to_string()),
            }
            dialogue.speak(connection);
        }
        None
    }
}

fn is_timeout(error: &std::io::Error) -> bool {
    use std::io::ErrorKind::{Interrupted, TimedOut, WouldBlock};
    matches!(error.kind(), TimedOut | WouldBlock | Interrupted)
}

/// What is said to the autopilot, and when.
#[derive(Debug, Default)]
struct Dialogue {
    /// The autopilot's system.
    system: Option<u32>,
    heartbeat: Option<Instant>,
    sampled: Option<Instant>,
    asked: Option<Instant>,
}

impl Dialogue {
    fn hear(&mut self, (system, component): Sender, message: &MavMessage) {
        if component == AUTOPILOT && self.system.is_none() {
            self.system = Some(system);
        }
        if sample(message).is_some_and(|sample| sample.kind == MessageKind::HighresImu) {
            self.sampled = Some(Instant::now());
        }
    }

    /// Sends what is due. A line that cannot be written to can still be read, so nothing is made of errors:
    /// the autopilot may be set to send without being asked.
    fn speak(&mut self, connection: &Connection<MavMessage>) {
        let is_due =
            |last: Option<Instant>, period| last.is_none_or(|last| last.elapsed() >= period);
        let Some(system_id) = self.system else { return };
        let header = MavHeader { system_id, component_id: ONBOARD_COMPUTER, sequence: 0 };
        if is_due(self.heartbeat, HEARTBEAT_PERIOD) {
            self.heartbeat = Some(Instant::now());
            let _ = connection.send(&header, &heartbeat());
        }
        if is_due(self.sampled, ASK_PERIOD) && is_due(self.asked, ASK_PERIOD) {
            self.asked = Some(Instant::now());
            // Commands are addressed with eight bits.
            for request in u8::try_from(system_id).ok().into_iter().flat_map(requests) {
                let _ = connection.send(&header, &request);
            }
        }
    }
}

fn heartbeat() -> MavMessage {
    MavMessage::HEARTBEAT(HEARTBEAT_DATA {
        custom_mode: 0,
        mavtype: MavType::MAV_TYPE_ONBOARD_CONTROLLER,
        autopilot: MavAutopilot::MAV_AUTOPILOT_INVALID,
        base_mode: MavModeFlag::empty(),
        system_status: MavState::MAV_STATE_ACTIVE,
        mavlink_version: 3,
    })
}

/// Asks for both messages: autopilots that do not have one answer so, and send the other.
fn requests(system: u8) -> [MavMessage; 2] {
    use mavlink::dialects::common::{ATTITUDE_QUATERNION_DATA, HIGHRES_IMU_DATA};
    [HIGHRES_IMU_DATA::ID, ATTITUDE_QUATERNION_DATA::ID].map(|message| {
        MavMessage::COMMAND_LONG(COMMAND_LONG_DATA {
            target_system: system,
            target_component: AUTOPILOT,
            command: MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL,
            confirmation: 0,
            param1: message as f32,
            param2: SAMPLE_INTERVAL_US,
            ..COMMAND_LONG_DATA::DEFAULT
        })
    })
}
