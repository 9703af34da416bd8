//! An instance in which a candidate runs alone.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, sync_channel};
use std::time::{Duration, Instant};

use anyhow::{Context as _, bail};
use flockeye_cli::signals;
use flockeye_config::{Resolved, Restart};
use flockeye_contract::{Health, Healths, StageName, StageState, Topic};
use flockeye_runtime::clock;
use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::instance::{Instance, Ownership};
use flockeye_runtime::memory::{Budget, shared_memory_space};
use flockeye_runtime::ports::{Ports, Subscriber, TopicServices, create_all_services};
use iceoryx2::prelude::*;

use super::report::{ConformanceReport, OWES};
use flockeye_launcher::control::WorkerName;
use flockeye_launcher::process::{LogLine, Process, ProcessChange, STOP_TIME};

/// Interval at which the test checks for messages.
const LOOK: Duration = Duration::from_micros(500);

/// Largest time between two health messages.
const LONGEST_SILENCE: Duration = Duration::from_millis(750);

/// Time after a candidate's end in which its last lines arrive.
const LAST_WORDS: Duration = Duration::from_millis(200);
/// Largest number of the candidate's lines that are kept.
const MOST_LINES: usize = 30;

/// A copy of a message: header and items.
pub(crate) type HeaderAndItems<T> = (<T as Topic>::Header, Vec<<T as Topic>::Item>);

/// An instance with one process, the candidate. The test takes the place of all others. Fields are
/// dropped in this order: ports, services, folder.
pub(crate) struct Bench {
    /// Ports of the test.
    pub ports: Ports,
    /// The checks so far.
    pub report: ConformanceReport,
    healths: Subscriber<Healths>,
    process: Process,
    log: Receiver<LogLine>,
    lines: Vec<String>,
    newest: Option<Health>,
    /// Time of sending of the newest health message, because the test may receive it later.
    sent_ns: i64,
    stopping: Arc<AtomicBool>,
    longest_silence: Duration,
    start_limit: Duration,
    /// The end of the process; `None` while it runs.
    ended: Option<String>,
    _services: Vec<TopicServices>,
    _ownership: Ownership,
}

impl Bench {
    /// Creates the instance of this configuration, without starting the candidate.
    ///
    /// # Errors
    /// The instance or its shared memory is not available, or the candidate's program does not
    /// exist.
    pub(crate) fn new(
        resolved: &Resolved,
        stage: StageName,
        command: &[String],
    ) -> anyhow::Result<Self> {
        set_log_level(LogLevel::Fatal);
        let instance = Instance::named(&resolved.pipeline.instance.0);
        let ownership = instance.take()?;
        let budget = Budget::of(resolved);
        let (free, total) = shared_memory_space().context("cannot look at /dev/shm")?;
        budget.check(free, total)?;
        instance.write_configuration(resolved)?;
        let node = instance.create_node("stage-test", "cannot create the instance")?;
        let services = create_all_services(&node, &budget)?;
        let mut ports = Ports::new(node, budget, SharedCounters::default());
        let healths = ports.subscriber()?;
        let mut process = resolved.pipeline.stages.of(stage).clone();
        process.restart = Restart::Never;
        if !command.is_empty() {
            process.command = command.to_vec();
        }
        let (sender, log) = sync_channel(1000);
        let worker = WorkerName { stage, replica: 0 };
        Ok(Self {
            ports,
            report: ConformanceReport::default(),
            healths,
            process: Process::new(worker, &process, instance.folder(), sender, false)?,
            log,
            lines: Vec::new(),
            newest: None,
            sent_ns: clock::monotonic_ns(),
            stopping: signals::stop_flag()?,
            longest_silence: Duration::ZERO,
            start_limit: Duration::from_secs_f64(resolved.pipeline.supervision.start_s),
            ended: None,
            _services: services,
            _ownership: ownership,
        })
    }

    /// Starts the candidate, and waits until it is ready. False: it did not become ready, so it
    /// cannot be tested.
    pub(crate) fn start(&mut self) -> anyhow::Result<bool> {
        self.process.start()?;
        let begun = Instant::now();
        let mut has_started = false;
        let ready = self.wait(self.start_limit, |bench| {
            let state = bench.newest.map(|health| health.state);
            has_started |= state == Some(StageState::Starting.code());
            Ok((state == Some(StageState::Ready.code())).then_some(()))
        })?;
        let limit_s = self.start_limit.as_secs_f64();
        self.report.check(
            "is ready in time",
            OWES,
            match (&ready, &self.ended) {
                (Some(()), _) => None,
                (None, Some(how)) => Some(format!("it {how} before it was ready")),
                (None, None) => {
                    Some(format!("it has not sent health with state ready in {limit_s} s"))
                }
            },
        );
        if ready.is_none() {
            return Ok(false);
        }
        self.report.figure("ready after", begun.elapsed().as_secs_f64(), "s");
        if let Some(health) = self.newest {
            let worker = self.process.worker;
            for (field, found, wanted) in [
                ("stage", health.stage.to_string(), worker.stage.name().to_owned()),
                ("replica", health.replica.to_string(), worker.replica.to_string()),
                ("generation", health.generation.to_string(), "0".to_owned()),
            ] {
                self.report.field("health says who it is", OWES, field, found, wanted);
            }
        }
        self.longest_silence = Duration::ZERO;
        Ok(true)
    }

    /// Calls `step` until it returns a value, for at most `limit`. Health is received meanwhile.
    pub(crate) fn wait<R>(
        &mut self,
        limit: Duration,
        mut step: impl FnMut(&mut Self) -> anyhow::Result<Option<R>>,
    ) -> anyhow::Result<Option<R>> {
        let begun = Instant::now();
        loop {
            self.look()?;
            if let Some(result) = step(self)? {
                return Ok(Some(result));
            }
            if begun.elapsed() > limit || self.ended.is_some() {
                return Ok(None);
            }
            std::thread::sleep(LOOK);
        }
    }

    /// The next message. The contract's check is noted under `what`.
    pub(crate) fn next<T: Topic>(
        &mut self,
        messages: &mut Subscriber<T>,
        what: &'static str,
        patience: Duration,
    ) -> anyhow::Result<Option<HeaderAndItems<T>>> {
        let found = self.wait(patience, |_| {
            let Some((message, verdict)) = messages.receive_with_verdict()? else {
                return Ok(None);
            };
            Ok(Some((message.header, message.items().to_vec(), verdict)))
        })?;
        Ok(found.map(|(header, items, verdict)| {
            self.report.verdict(what, verdict);
            (header, items)
        }))
    }

    /// Whether the candidate has reported that its input has ended.
    pub(crate) fn is_finished(&self) -> bool {
        self.newest.is_some_and(|health| health.state == StageState::Finished.code())
    }

    /// Waits for this time.
    pub(crate) fn pass(&mut self, time: Duration) -> anyhow::Result<()> {
        self.wait(time, |_| Ok(None::<()>)).map(drop)
    }

    /// Checks that the candidate runs.
    pub(crate) fn runs(&mut self) -> bool {
        let wrong = self.ended.as_ref().map(|how| format!("it {how}"));
        let runs = wrong.is_none();
        self.report.check("runs until it is told to stop", OWES, wrong);
        runs
    }

    /// Number of published messages in the candidate's newest health.
    pub(super) fn published(&self) -> Option<u64> {
        self.newest.map(|health| health.published)
    }

    /// Resident memory of the candidate, megabytes.
    pub(crate) fn resident_mb(&self) -> f64 {
        self.newest.map_or(0.0, |health| health.resident_bytes as f64 / 1e6)
    }

    fn note_silence_until(&mut self, now_ns: i64) {
        let silence_ns = now_ns.saturating_sub(self.sent_ns).max(0).unsigned_abs();
        self.longest_silence = self.longest_silence.max(Duration::from_nanos(silence_ns));
    }

    fn look(&mut self) -> anyhow::Result<()> {
        while let Some((message, _)) = self.healths.receive_with_verdict()? {
            self.note_silence_until(message.header.sent_ns);
            (self.newest, self.sent_ns) = (Some(message.header), message.header.sent_ns);
        }
        if self.stopping.load(Ordering::Relaxed) {
            bail!("interrupted");
        }
        self.read_log(Duration::ZERO);
        if self.ended.is_none()
            && let ProcessChange::Ended { end, .. } = self.process.attend(false, || {})?
        {
            self.ended = Some(end.how);
            // The last lines of the process may arrive later.
            self.read_log(LAST_WORDS);
        }
        Ok(())
    }

    /// Reads the candidate's output, and waits this long for each further line.
    fn read_log(&mut self, patience: Duration) {
        while let Ok(line) = self.log.recv_timeout(patience) {
            if self.lines.len() < MOST_LINES {
                self.lines.push(line.text);
            }
        }
    }

    /// Sends SIGTERM to the candidate, and checks its end.
    pub(crate) fn stop(&mut self) -> anyhow::Result<()> {
        if !self.runs() {
            return Ok(());
        }
        self.note_silence_until(clock::monotonic_ns());
        let silence_s = self.longest_silence.as_secs_f64();
        self.report.holds(
            "health comes every 250 ms",
            OWES,
            self.longest_silence < LONGEST_SILENCE,
            || format!("none came for {silence_s:.1} s"),
        );
        self.process.signal(rustix::process::Signal::TERM);
        let begun = Instant::now();
        self.wait(STOP_TIME, |bench| Ok(bench.ended.as_ref().map(|_| ())))?;
        let limit_s = STOP_TIME.as_secs_f64();
        self.report.check(
            "ends at SIGTERM",
            OWES,
            match &self.ended {
                None => Some(format!("it still runs {limit_s} s after SIGTERM")),
                Some(how) if how.contains("status 0") => None,
                Some(how) => Some(format!("it {how} after SIGTERM, and must end with status 0")),
            },
        );
        self.report.figure("ended after", begun.elapsed().as_secs_f64(), "s");
        Ok(())
    }

    /// Ends the instance. Returns the checks and the candidate's output.
    pub(crate) fn finish(mut self) -> (ConformanceReport, String) {
        self.process.signal(rustix::process::Signal::KILL);
        // Errors and output after the kill are ignored.
        let _ = self.wait(Duration::from_secs(1), |bench| Ok(bench.ended.as_ref().map(|_| ())));
        (self.report, self.lines.join("\n"))
    }
}
