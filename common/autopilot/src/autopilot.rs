//! The autopilot's interface for callers, and the threads of its line.

use std::io;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::thread::{self, Builder, JoinHandle};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use flockeye_config::{Autopilot, MavlinkAddress};
use flockeye_runtime::backoff::Backoff;
use flockeye_runtime::clock;
use flockeye_runtime::logs::Throttle;
use mavlink::MavHeader;

use crate::core::Core;
use crate::error::AutopilotError;
use crate::link::{self, LineReader, LineWriter};
use crate::neighbour::NeighbourState;
use crate::odometry::OdometryState;
use crate::timesync::TimeOffset;
use flockeye_runtime::lock::lock;

/// Minimum and maximum wait before a line that failed is opened again.
const RETRY: [Duration; 2] = [Duration::from_millis(500), Duration::from_secs(5)];
/// Time after which an open line counts as steady: its loss is logged again, and it is soon
/// retried.
const STEADY: Duration = Duration::from_secs(5);
/// Maximum wait of the sending thread.
const LONGEST_WAIT: Duration = Duration::from_millis(100);

/// The drone's autopilot, until dropped. Threads of its own send and receive; no method waits for
/// the line.
#[derive(Debug)]
pub struct AutopilotLine {
    state: Arc<LineState>,
    thread: Option<JoinHandle<()>>,
}

/// State of the line.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct AutopilotStatus {
    /// Whether the line is open. Even then there may be no autopilot at its other end.
    pub is_open: bool,
    /// Whether a message of this vehicle's autopilot arrived within the last three seconds.
    pub is_heard: bool,
    /// Offset of the autopilot's clock; none while it is unknown.
    pub time_offset: Option<TimeOffset>,
    /// Messages that were sent.
    pub sent: u64,
    /// Messages that were dropped: nothing received them, or the line was full.
    pub dropped: u64,
    /// Messages of the autopilot that were received.
    pub received: u64,
}

/// State that the caller and the threads share.
#[derive(Debug)]
struct LineState {
    address: MavlinkAddress,
    system_id: u8,
    component_id: u8,
    core: Mutex<Core>,
    /// Signals that a message is due sooner, or that the threads must stop.
    changed: Condvar,
    is_stopping: AtomicBool,
    is_open: AtomicBool,
    sent: AtomicU64,
    dropped: AtomicU64,
    received: AtomicU64,
}

impl AutopilotLine {
    /// Starts the threads of the line. A line that cannot be opened is retried in the background.
    ///
    /// # Errors
    /// [`AutopilotError::Link`] for an invalid address, [`AutopilotError::Thread`] where no thread
    /// can be started. The other settings are checked with the configuration.
    pub fn open(settings: &Autopilot) -> Result<Self, AutopilotError> {
        let address = MavlinkAddress::parse(&settings.link)
            .map_err(|reason| AutopilotError::Link { found: settings.link.clone(), reason })?;
        let utc = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let utc_ns = i64::try_from(utc.as_nanos()).unwrap_or(i64::MAX);
        let utc_less_monotonic_ns = utc_ns.saturating_sub(clock::monotonic_ns());
        let state = Arc::new(LineState {
            address,
            system_id: settings.system_id,
            component_id: settings.component_id,
            core: Mutex::new(Core::new(settings.clone(), utc_less_monotonic_ns)),
            changed: Condvar::new(),
            is_stopping: AtomicBool::new(false),
            is_open: AtomicBool::new(false),
            sent: AtomicU64::new(0),
            dropped: AtomicU64::new(0),
            received: AtomicU64::new(0),
        });
        let line = state.clone();
        let name = "autopilot";
        let thread = Builder::new()
            .name(name.into())
            .spawn(move || line.run())
            .map_err(|source| AutopilotError::Thread { name, source })?;
        Ok(Self { state, thread: Some(thread) })
    }

    /// Sends a neighbour's state to the autopilot as soon as its rate and the line allow. A newer
    /// state of the same neighbour replaces one that waits. Returns at once.
    ///
    /// # Errors
    /// [`AutopilotError::Neighbour`] for an invalid state, [`AutopilotError::TooManyNeighbours`]
    /// where 64 others are fresh.
    pub fn neighbour(&self, state: &NeighbourState) -> Result<(), AutopilotError> {
        lock(&self.state.core).on_neighbour(state, clock::monotonic_ns())?;
        self.state.changed.notify_all();
        Ok(())
    }

    /// The autopilot's newest estimate of this drone's motion; each is returned once.
    pub fn take_odometry(&self) -> Option<OdometryState> {
        lock(&self.state.core).take_odometry()
    }

    /// State of the line.
    pub fn status(&self) -> AutopilotStatus {
        let now_ns = clock::monotonic_ns();
        let (is_heard, time_offset) = {
            let core = lock(&self.state.core);
            (core.is_heard(now_ns), core.time_offset(now_ns))
        };
        AutopilotStatus {
            is_open: self.state.is_open.load(Relaxed),
            is_heard,
            time_offset,
            sent: self.state.sent.load(Relaxed),
            dropped: self.state.dropped.load(Relaxed),
            received: self.state.received.load(Relaxed),
        }
    }
}

impl Drop for AutopilotLine {
    /// Ends the threads, which takes a fifth of a second at most.
    fn drop(&mut self) {
        self.state.stop();
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::error!("the thread that talks to the autopilot panicked");
        }
    }
}

impl LineState {
    fn stop(&self) {
        // The lock prevents that a thread which is about to wait misses the signal.
        let core = lock(&self.core);
        self.is_stopping.store(true, Relaxed);
        drop(core);
        self.changed.notify_all();
    }

    fn is_stopping(&self) -> bool {
        self.is_stopping.load(Relaxed)
    }

    /// Waits for `time`, or until the threads must stop.
    fn pause(&self, time: Duration) {
        let began = Instant::now();
        let mut core = lock(&self.core);
        while !self.is_stopping() {
            let Some(left) = time.checked_sub(began.elapsed()) else { return };
            core = self.changed.wait_timeout(core, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// Opens the line again after each loss. An error is logged once, until the line has worked
    /// again.
    fn run(&self) {
        let mut backoff = Backoff::new(RETRY[0], RETRY[1]);
        let mut is_said = false;
        while !self.is_stopping() {
            let opened = Instant::now();
            let lost = link::open(&self.address).and_then(|(reader, writer)| {
                tracing::info!("the line to the autopilot, {}, is open", self.address);
                self.serve(reader, writer)
            });
            if opened.elapsed() > STEADY {
                backoff.reset();
                is_said = false;
            }
            if let Err(error) = lost
                && !std::mem::replace(&mut is_said, true)
            {
                let cure = self.address.cure();
                tracing::warn!(
                    "no line to the autopilot, {}: {error}; it is tried again. Cure: {cure}",
                    self.address
                );
            }
            self.pause(backoff.after_failure());
        }
    }

    /// Reads and writes until the line is lost, or the threads must stop.
    fn serve(&self, mut reader: LineReader, mut writer: LineWriter) -> io::Result<()> {
        lock(&self.core).on_line();
        self.is_open.store(true, Relaxed);
        let is_over = AtomicBool::new(false);
        let served = thread::scope(|scope| {
            let reading = Builder::new().name("autopilot-in".into()).spawn_scoped(scope, || {
                let read = self.read(&mut reader, &is_over);
                is_over.store(true, Relaxed);
                read
            })?;
            let written = self.write(&mut writer, &is_over);
            is_over.store(true, Relaxed);
            let read = reading.join().unwrap_or_else(|_| Err(io::Error::other("a panic")));
            written.and(read)
        });
        self.is_open.store(false, Relaxed);
        served
    }

    fn read(&self, reader: &mut LineReader, is_over: &AtomicBool) -> io::Result<()> {
        let mut has_warned = false;
        while !self.is_stopping() && !is_over.load(Relaxed) {
            reader.read(&mut |sender, message| {
                let arrived_ns = clock::monotonic_ns();
                let mut core = lock(&self.core);
                let is_autopilot = core.on_message(sender, message, arrived_ns);
                let has_news = core.next_due_ns(arrived_ns) <= arrived_ns;
                let other = core.other_system();
                drop(core);
                if is_autopilot {
                    self.received.fetch_add(1, Relaxed);
                }
                if has_news {
                    self.changed.notify_all();
                }
                if let Some(other) = other
                    && !std::mem::replace(&mut has_warned, true)
                {
                    tracing::warn!(
                        "{}: the autopilot of system {other} is heard, not that of {}. Cure: system_id: {other}, if \
                         it is this drone's",
                        self.address,
                        self.system_id
                    );
                }
                is_autopilot
            })?;
        }
        Ok(())
    }

    fn write(&self, writer: &mut LineWriter, is_over: &AtomicBool) -> io::Result<()> {
        let mut header = MavHeader {
            system_id: self.system_id.into(),
            component_id: self.component_id,
            sequence: 0,
        };
        let mut drops = Throttle::default();
        while !self.is_stopping() && !is_over.load(Relaxed) {
            for message in self.due() {
                let frame = message.frame(header);
                if writer.write(frame.raw_bytes())? {
                    header.sequence = header.sequence.wrapping_add(1);
                    self.sent.fetch_add(1, Relaxed);
                    continue;
                }
                self.dropped.fetch_add(1, Relaxed);
                if matches!(self.address, MavlinkAddress::Serial { .. })
                    && let Some(more) = drops.admit()
                {
                    tracing::warn!(
                        more_since = more,
                        "{}: the line takes no more. Cure: a higher rate of the line, lower rates of the messages",
                        self.address
                    );
                }
                // The other due messages would be stale when the line accepts them.
                break;
            }
        }
        Ok(())
    }

    /// Waits for due messages.
    fn due(&self) -> Vec<crate::messages::Outgoing> {
        let mut core = lock(&self.core);
        let now_ns = clock::monotonic_ns();
        let wait = clock::until(core.next_due_ns(now_ns), now_ns).min(LONGEST_WAIT);
        if !wait.is_zero() && !self.is_stopping() {
            core = self.changed.wait_timeout(core, wait).unwrap_or_else(PoisonError::into_inner).0;
        }
        core.due(clock::monotonic_ns())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_that_cannot_work_is_refused_with_its_cure() {
        let settings = Autopilot { link: "udpin:14540".into(), ..Autopilot::default() };
        let error = AutopilotLine::open(&settings).map(drop).map_err(|error| error.to_string());
        assert!(error.is_err_and(|error| {
            error.starts_with("link: 'udpin:14540'") && error.contains("udpin:0.0.0.0")
        }));
    }
}
