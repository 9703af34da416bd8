//! Runs a pipeline: starts its processes, watches them, replaces those that fail, and stops them.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`faults`] | notices processes that end, hang, start too slowly or do not do what they owe |
//! | [`recording`] | runs the recorder, where flights are recorded |
//! | [`requests`] | does what clients ask for by the control channel |
//! | [`swaps`] | replaces a process in flight |
//! | [`taking_over`] | goes on with the processes that an earlier launcher left flying |

mod faults;
mod recording;
mod requests;
mod swaps;
pub(crate) mod taking_over;
pub(crate) mod unfinished;

use std::rc::Rc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, sync_channel};
use std::time::{Duration, Instant};

use anyhow::Context;
use flockeye_cli::Screen;
use flockeye_config::{Pipeline, Resolved};
use flockeye_contract::{Complaints, HandOver, HandOverState, HandOvers, StageName, StageState};
use flockeye_runtime::clock;
use flockeye_runtime::health::Counters;
use flockeye_runtime::instance::{Instance, Ownership};
use flockeye_runtime::memory::Budget;
use flockeye_runtime::ports::{Ports, Publisher, Subscriber, TopicServices, create_all_services};
use iceoryx2::prelude::*;
use rustix::process::Signal;

use self::recording::Recorder;
use self::requests::Pending;
use self::swaps::Replacement;
use crate::control::Worker;
use crate::control::server::Server;
use crate::fault_point;
use crate::process::{Condition, LogLine, Process, STOP_TIME};
use crate::run_log::{RunLog, RunOptions, RunSummary};
use crate::service_manager::{Progress, ServiceManager};
use crate::swap::Swap;

/// A recording has ended when its source says so and no track has come for this long.
const QUIET_TIME: Duration = Duration::from_millis(1000);
/// Lines of log that may wait to be shown.
const LOG_LINES: usize = 1_000;
/// How often the processes and the control channel are looked after.
const TICK: Duration = Duration::from_millis(20);

/// A pipeline that runs.
pub(crate) struct Supervisor<'a> {
    duration: Option<Duration>,
    // Dropped in this order: ports before the services, the services before the node.
    messages: RunLog,
    hand_overs: Publisher<HandOvers>,
    complaints: Subscriber<Complaints>,
    swap: Option<Swap>,
    ports: Option<Ports>,
    _services: Vec<TopicServices>,
    node: Rc<Node<ipc::Service>>,
    budget: Budget,
    /// The configuration as it is now.
    pipeline: Pipeline,
    instance: Instance,
    server: Server,
    /// All workers, the source last.
    processes: Vec<Process>,
    /// Processes that were replaced and have not ended.
    retired: Vec<Process>,
    /// Where flights are recorded.
    recorder: Option<Recorder>,
    pending: Vec<Pending>,
    replacement: Option<Replacement>,
    /// Whose old program is to be started again, and the generation that it follows.
    putting_back: Option<(Worker, u32)>,
    /// A swap is over, and the process that does not count has yet to end.
    awaits_silence: bool,
    /// Whether the processes fly on when this one dies.
    is_kept: bool,
    is_asked_to_end: bool,
    log: Receiver<LogLine>,
    screen: &'a mut Screen,
    started: Instant,
    source_started: Option<Instant>,
    next_show: Instant,
    service_manager: Option<ServiceManager>,
}

impl<'a> Supervisor<'a> {
    /// Creates the shared memory and prepares the processes of a pipeline whose instance is taken.
    ///
    /// # Errors
    /// Shared memory, the control channel or a file cannot be opened, or a stage's program is missing.
    pub(crate) fn new(
        options: &RunOptions,
        resolved: &Resolved,
        instance: &Instance,
        budget: Budget,
        screen: &'a mut Screen,
    ) -> anyhow::Result<Self> {
        let node = Rc::new(
            NodeBuilder::new()
                .name(&NodeName::new("launcher").context("node name")?)
                .signal_handling_mode(SignalHandlingMode::Disabled)
                .config(&instance.iceoryx2()?)
                .create::<ipc::Service>()
                .map_err(|error| anyhow::anyhow!("cannot open shared memory: {error:?}"))?,
        );
        // A launcher that was killed while its stages fly on.
        node.blocking_cleanup_dead_nodes(Duration::from_secs(1));
        let services = create_all_services(&node, &budget)?;
        let mut ports = Ports::new(node.clone(), budget.clone(), Rc::new(Counters::default()));
        let (sender, log) = sync_channel(LOG_LINES);
        let pipeline = &resolved.pipeline;
        // Against the dataflow, so that a reader is there before what writes to it.
        let stages = StageName::ALL.into_iter().rev().filter(|stage| !stage.is_source());
        let workers = stages
            .filter(|&stage| pipeline.runs(stage))
            .flat_map(|stage| (0..pipeline.replicas(stage)).map(move |replica| (stage, replica)))
            .chain([(pipeline.source.stage(), 0)]);
        let processes = workers
            .map(|(stage, replica)| {
                let worker = Worker { stage, replica };
                let configuration = pipeline.stages.of(stage);
                let log = sender.clone();
                Process::new(worker, configuration, instance.folder(), log, options.keep)
            })
            .collect::<anyhow::Result<Vec<_>>>()?;
        let now = Instant::now();
        fault_point::NOTICE.into_iter().for_each(|notice| screen.line(notice));
        Ok(Self {
            duration: options.duration,
            messages: RunLog::open(resolved, options, &mut ports)?,
            hand_overs: ports.publisher()?,
            complaints: ports.subscriber()?,
            swap: None,
            ports: Some(ports),
            _services: services,
            node,
            budget,
            pipeline: pipeline.clone(),
            instance: instance.clone(),
            server: Server::open(instance.folder())?,
            processes,
            retired: Vec::new(),
            recorder: Recorder::of(&pipeline.recording, instance, sender)?,
            pending: Vec::new(),
            replacement: None,
            putting_back: None,
            awaits_silence: false,
            is_kept: options.keep,
            is_asked_to_end: false,
            log,
            screen,
            started: now,
            source_started: None,
            next_show: now,
            service_manager: ServiceManager::of_environment(),
        })
    }

    /// Starts the consumers that do not run yet; the source follows when they are ready.
    ///
    /// # Errors
    /// The system cannot start a process.
    pub(crate) fn start(&mut self) -> anyhow::Result<()> {
        self.recorder.as_mut().map_or(Ok(()), Recorder::start)?;
        let consumers = self.processes.iter_mut().filter(|process| {
            !process.worker.stage.is_source() && process.condition() == Condition::New
        });
        consumers.into_iter().try_for_each(Process::start)
    }

    /// Watches everything until it is time to stop.
    ///
    /// # Errors
    /// Nothing works any more, or a file cannot be written.
    pub(crate) fn watch(&mut self, stopping: &AtomicBool) -> anyhow::Result<()> {
        let Some(ports) = self.ports.take() else { return Ok(()) };
        let outcome = ports.attend(|| {
            self.messages.receive()?;
            self.hand_overs.update_connections()?;
            self.show_log();
            self.look_after_processes()?;
            self.look_after_recorder();
            self.look_after_swap(&ports)?;
            self.serve_clients(&ports)?;
            self.start_source_in_time()?;
            let time_is_up = self.duration.is_some_and(|duration| {
                self.source_started.is_some_and(|start| start.elapsed() >= duration)
            });
            let is_over = stopping.load(Ordering::Relaxed) || self.is_asked_to_end || time_is_up;
            if is_over || self.messages.is_complete() || self.is_at_end() {
                return Ok(None);
            }
            self.show();
            self.tell_service_manager();
            Ok(Some(TICK))
        });
        self.ports = Some(ports);
        outcome
    }

    fn look_after_recorder(&mut self) {
        let node = &self.node;
        let said = self.recorder.as_mut().and_then(|recorder| {
            // The dead process's ports are freed before its successor asks for its own.
            recorder.attend(|| {
                node.blocking_cleanup_dead_nodes(Duration::from_secs(1));
            })
        });
        if let Some(said) = said {
            self.screen.line(&said);
        }
    }

    /// Starts the source when all others are ready, or after a while: a foreign stage may send no health.
    fn start_source_in_time(&mut self) -> anyhow::Result<()> {
        if self.source_started.is_some()
            || !(self.all_are_ready() || self.started.elapsed() > self.start_time())
        {
            return Ok(());
        }
        let is_new = |process: &&mut Process| {
            process.worker.stage.is_source() && process.condition() == Condition::New
        };
        self.processes.iter_mut().find(is_new).map_or(Ok(()), Process::start)?;
        self.source_started = Some(Instant::now());
        self.messages.expect_tracks();
        Ok(())
    }

    /// How long a stage may take to be ready.
    fn start_time(&self) -> Duration {
        Duration::from_secs_f64(self.pipeline.supervision.start_s)
    }

    /// Whether every stage has opened what it needs, and the recorder misses nothing. A degraded stage counts:
    /// it waits for something outside, such as a gateway for its network port.
    fn all_are_ready(&self) -> bool {
        let consumers = self.processes.iter().filter(|process| !process.worker.stage.is_source());
        consumers.into_iter().all(|process| self.is_ready(process.worker))
            && self.recorder.as_ref().is_none_or(Recorder::has_joined)
    }

    /// Whether a worker has reported that it is ready.
    fn is_ready(&self, worker: Worker) -> bool {
        let state = self.messages.state_of(worker.stage.name(), worker.replica);
        matches!(state, Some(StageState::Ready | StageState::Degraded))
    }

    fn is_at_end(&self) -> bool {
        self.messages.state_of(self.pipeline.source.stage().name(), 0) == Some(StageState::Finished)
            && self.messages.quiet_time() > QUIET_TIME
    }

    /// Whether it ran for longer than it takes to start.
    pub(crate) fn had_its_time(&self) -> bool {
        self.source_started.is_some_and(|start| start.elapsed() > self.start_time())
            || self.is_at_end()
    }

    /// Says whose messages count, here and everywhere.
    fn announce(&self, ports: &Ports, word: HandOver) -> anyhow::Result<()> {
        let folder = self.instance.folder();
        let step = match HandOverState::try_from(word.state)? {
            HandOverState::TakenOver if word.new_generation < word.old_generation => "taking back",
            HandOverState::TakenOver => "taking over",
            HandOverState::Shadow => "the shadow",
            HandOverState::Nothing => "the end",
        };
        if self.is_kept {
            taking_over::write_word(folder, &word);
        }
        fault_point::pass(folder, &format!("{step} is written"));
        ports.listening().set(word);
        self.hand_overs.send(word, &[])?;
        fault_point::pass(folder, &format!("{step} is said"));
        Ok(())
    }

    fn show_log(&mut self) {
        while let Ok(LogLine { stage, text }) = self.log.try_recv() {
            self.screen.stage_line(self.started.elapsed().as_secs_f64(), &stage, &text);
        }
    }

    fn show(&mut self) {
        if Instant::now() < self.next_show {
            return;
        }
        let now_ns = clock::monotonic_ns();
        if self.screen.is_live() {
            self.screen.table(&self.messages.dashboard.table(now_ns));
            self.next_show = Instant::now() + Duration::from_millis(200);
        } else {
            // Under systemd the newest line is the unit's status, and the journal need not keep them all.
            if self.service_manager.is_none() && self.messages.dashboard.frames_ended() > 0 {
                self.screen.line(&self.messages.dashboard.line(now_ns));
            }
            self.next_show = Instant::now() + Duration::from_secs(1);
        }
    }

    fn tell_service_manager(&mut self) {
        let Some(manager) = &mut self.service_manager else { return };
        let dashboard = &self.messages.dashboard;
        let is_held_up =
            self.processes.iter().any(|process| process.condition() == Condition::Stopped);
        let progress = Progress { frames_ended: dashboard.frames_ended(), is_held_up };
        manager.report(progress, Instant::now(), || dashboard.line(clock::monotonic_ns()));
    }

    /// Stops every stage: asks first, then kills.
    pub(crate) fn stop(&mut self) {
        self.service_manager.iter_mut().for_each(ServiceManager::stopping);
        let candidate = self.swap.iter_mut().map(|swap| &mut swap.candidate);
        let mut processes: Vec<_> =
            self.processes.iter_mut().chain(&mut self.retired).chain(candidate).collect();
        processes.iter().for_each(|process| process.signal(Signal::TERM));
        let deadline = Instant::now() + STOP_TIME;
        while Instant::now() < deadline && !processes.iter_mut().all(|process| process.has_ended())
        {
            std::thread::sleep(Duration::from_millis(5));
        }
        for process in &mut processes {
            if !process.has_ended() {
                self.screen.line(&format!("{} does not stop and is killed", process.label()));
                process.signal(Signal::KILL);
                while !process.has_ended() {
                    std::thread::sleep(Duration::from_millis(1));
                }
            }
        }
        // Last, so that it has heard everything.
        if let Some(said) = self.recorder.as_mut().and_then(Recorder::stop) {
            self.screen.line(&said);
        }
        self.show_log();
    }

    /// Shows the summary, completes the files and frees shared memory.
    ///
    /// # Errors
    /// A file cannot be written.
    pub(crate) fn finish(mut self, ownership: Ownership) -> anyhow::Result<RunSummary> {
        let summary = self.messages.finish()?;
        if summary.frames > 0 {
            self.screen.line(&self.messages.dashboard.summary());
        } else {
            self.screen.line("no frame was searched to its end");
        }
        // Shared memory is unmapped before its files are removed.
        drop(self);
        drop(ownership);
        Ok(summary)
    }
}
