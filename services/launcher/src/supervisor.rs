//! Runs a pipeline: starts its processes, watches them, replaces those that fail, and stops them.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`console`] | shows the run to the user and to systemd |
//! | [`faults`] | notices processes that end, hang, start too slowly or do not do what they must |
//! | [`hand_over`] | announces which process counts |
//! | [`recorder`] | runs the recorder, where flights are recorded |
//! | [`requests`] | handles the requests of clients over the control channel |
//! | [`shared_memory`] | creates all topics |
//! | [`swaps`] | replaces a process in flight |
//! | [`taking_over`] | takes over the processes that an earlier launcher left flying |
//! | [`unfinished_swap`] | restores the state before a swap whose launcher died |
//! | [`waiting_client`] | answers clients when a worker reaches a requested condition |
//! | [`workers`] | holds the processes of all workers |

mod console;
mod faults;
mod hand_over;
mod recorder;
mod requests;
mod shared_memory;
mod swaps;
mod taking_over;
pub(crate) mod unfinished_swap;
mod waiting_client;
mod workers;

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::sync_channel;
use std::time::{Duration, Instant};

use flockeye_cli::Screen;
use flockeye_config::{Pipeline, Resolved};
use flockeye_contract::{Complaints, StageState};
use flockeye_runtime::instance::{Instance, Ownership};
use flockeye_runtime::memory::Budget;
use flockeye_runtime::ports::{Ports, Subscriber};

use self::console::Console;
use self::hand_over::HandOverNotice;
use self::recorder::Recorder;
use self::shared_memory::SharedMemory;
use self::waiting_client::WaitingClient;
use self::workers::Workers;
use crate::control::server::Server;
use crate::fault_point;
use crate::run_log::{RunLog, RunOptions, RunSummary};
use crate::swap::changeover::Changeover;

/// Time without a track after which a recording has ended, once its source has reported the end.
const QUIET_TIME: Duration = Duration::from_millis(1000);
/// Maximum number of log lines that wait to be shown.
const LOG_LINES: usize = 1_000;
/// Period of the checks of processes and control channel.
const TICK: Duration = Duration::from_millis(20);

/// A pipeline that runs.
pub(crate) struct Supervisor<'a> {
    // Fields drop in this order: ports before the shared memory.
    messages: RunLog,
    hand_over: HandOverNotice,
    complaints: Subscriber<Complaints>,
    changeover: Changeover,
    ports: Option<Ports>,
    memory: SharedMemory,
    instance: Instance,
    /// The current configuration.
    pipeline: Pipeline,
    /// Whether the processes fly on when this one dies.
    is_kept: bool,
    workers: Workers,
    /// Recorder, where flights are recorded.
    recorder: Option<Recorder>,
    server: Server,
    waiting_clients: Vec<WaitingClient>,
    is_asked_to_end: bool,
    started: Instant,
    source_started: Option<Instant>,
    /// Running time of the source; `None`: until the user ends the run.
    duration: Option<Duration>,
    console: Console<'a>,
}

impl<'a> Supervisor<'a> {
    /// Creates the shared memory and prepares the processes of a pipeline whose instance is taken.
    ///
    /// # Errors
    /// Shared memory, the control channel or a file cannot be opened, or a stage's program is
    /// missing.
    pub(crate) fn new(
        options: &RunOptions,
        resolved: &Resolved,
        instance: &Instance,
        budget: Budget,
        screen: &'a mut Screen,
    ) -> anyhow::Result<Self> {
        let memory = SharedMemory::create(instance, budget)?;
        let mut ports = memory.ports();
        let (sender, log) = sync_channel(LOG_LINES);
        let (pipeline, is_kept) = (&resolved.pipeline, options.keep);
        let workers = Workers::prepare(pipeline, instance, &sender, is_kept)?;
        fault_point::NOTICE.into_iter().for_each(|notice| screen.line(notice));
        Ok(Self {
            messages: RunLog::open(resolved, options, &mut ports)?,
            hand_over: HandOverNotice::open(&mut ports, instance, is_kept)?,
            complaints: ports.subscriber()?,
            changeover: Changeover::Nothing,
            ports: Some(ports),
            memory,
            instance: instance.clone(),
            pipeline: pipeline.clone(),
            is_kept,
            workers,
            recorder: Recorder::of(&pipeline.recording, instance, sender)?,
            server: Server::open(instance.folder())?,
            waiting_clients: Vec::new(),
            is_asked_to_end: false,
            started: Instant::now(),
            source_started: None,
            duration: options.duration,
            console: Console::new(screen, log),
        })
    }

    /// Starts the consumers that do not run yet; the source follows when they are ready.
    pub(crate) fn start(&mut self) -> anyhow::Result<()> {
        self.recorder.as_mut().map_or(Ok(()), Recorder::start)?;
        self.workers.start_consumers()
    }

    /// Runs the loop until the pipeline must stop.
    pub(crate) fn watch(&mut self, stopping: &AtomicBool) -> anyhow::Result<()> {
        let Some(ports) = self.ports.take() else { return Ok(()) };
        let outcome = ports.attend(|| {
            self.messages.receive()?;
            self.hand_over.update_connections()?;
            self.console.show_log();
            self.look_after_processes()?;
            self.look_after_recorder();
            self.look_after_swap(&ports)?;
            self.serve_clients(&ports)?;
            self.end_hand_over(&ports)?;
            self.start_source_in_time()?;
            let is_over = stopping.load(Ordering::Relaxed)
                || self.is_asked_to_end
                || self.duration.is_some_and(|duration| self.source_has_run(duration))
                || self.messages.is_complete()
                || self.is_at_end();
            if is_over {
                return Ok(None);
            }
            self.console.show(&self.messages.dashboard);
            self.console.report_progress(&self.messages.dashboard, self.workers.has_stopped());
            Ok(Some(TICK))
        });
        self.ports = Some(ports);
        outcome
    }

    fn look_after_recorder(&mut self) {
        let memory = &self.memory;
        // The dead process's ports are freed before its successor opens new ones.
        let change =
            self.recorder.as_mut().and_then(|recorder| recorder.attend(|| memory.clean_up()));
        if let Some(text) = change {
            self.console.line(&text);
        }
    }

    /// Starts the source when all others are ready, or after a timeout: a foreign stage may send no
    /// health.
    fn start_source_in_time(&mut self) -> anyhow::Result<()> {
        if self.source_started.is_some()
            || !(self.all_are_ready() || self.started.elapsed() > self.start_time())
        {
            return Ok(());
        }
        self.workers.start_source()?;
        self.source_started = Some(Instant::now());
        self.messages.last_track = Instant::now();
        Ok(())
    }

    /// Maximum time until a stage is ready.
    fn start_time(&self) -> Duration {
        Duration::from_secs_f64(self.pipeline.supervision.start_s)
    }

    /// Whether every stage is ready and the recorder misses nothing. A degraded stage counts: it
    /// waits for something external, such as a camera or a network port.
    fn all_are_ready(&self) -> bool {
        let mut workers = self.workers.processes.iter().map(|process| process.worker);
        workers.all(|worker| worker.stage.is_source() || self.messages.is_ready(worker))
            && self.recorder.as_ref().is_none_or(Recorder::has_joined)
    }

    fn source_has_finished(&self) -> bool {
        self.messages.dashboard.state_of(self.pipeline.source.stage().name(), 0)
            == Some(StageState::Finished)
    }

    fn is_at_end(&self) -> bool {
        self.source_has_finished() && self.messages.last_track.elapsed() > QUIET_TIME
    }

    /// Whether it ran longer than its start time.
    pub(crate) fn had_its_time(&self) -> bool {
        self.source_has_run(self.start_time()) || self.is_at_end()
    }

    /// Whether the source was started this long ago.
    fn source_has_run(&self, time: Duration) -> bool {
        self.source_started.is_some_and(|start| start.elapsed() >= time)
    }

    /// Stops every stage: first by SIGTERM, then by SIGKILL.
    pub(crate) fn stop(&mut self) {
        self.console.report_stop();
        self.workers.stop(self.changeover.new_process(), &mut self.console);
        // The recorder ends last, so that it has recorded everything.
        if let Some(text) = self.recorder.as_mut().and_then(Recorder::stop) {
            self.console.line(&text);
        }
        self.console.show_log();
    }

    /// Shows the summary, completes the files and frees shared memory.
    pub(crate) fn finish(mut self, ownership: Ownership) -> anyhow::Result<RunSummary> {
        let summary = self.messages.finish()?;
        if summary.frames > 0 {
            self.console.line(&self.messages.dashboard.summary());
        } else {
            self.console.line("no frame was searched to its end");
        }
        // Shared memory is unmapped before its files are removed.
        drop(self);
        drop(ownership);
        Ok(summary)
    }
}
