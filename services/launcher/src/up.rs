//! `flockeye up`: runs a pipeline until it ends.

use std::rc::Rc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, sync_channel};
use std::time::{Duration, Instant};

use anyhow::Context;
use clap::Args;
use flockeye_cli::{Configuration, Screen, signals};
use flockeye_config::{Pipeline, Resolved};
use flockeye_contract::{StageName, StageState};
use flockeye_dictionary::Dictionary;
use flockeye_runtime::clock;
use flockeye_runtime::health::Counters;
use flockeye_runtime::instance::{Instance, Ownership};
use flockeye_runtime::memory::{Budget, shared_memory_space};
use flockeye_runtime::ports::{Ports, TopicServices, create_all_services};
use iceoryx2::prelude::*;
use rustix::process::Signal;

use crate::process::{LogLine, Process, ProcessChange};
use crate::run_log::{RunLog, RunOptions, RunSummary};

/// How long stages get to stop by themselves. With what follows, Ctrl-C takes under 2 seconds.
const STOP_TIME: Duration = Duration::from_millis(1400);
/// A source starts when all others are ready, or after this (a foreign stage may send no health).
const READY_TIME: Duration = Duration::from_secs(10);
/// A stage that has sent health before and sends none for this long is hung.
const HUNG_NS: i64 = 15_000_000_000;
/// A recording has ended when its source says so and no track has come for this long.
const QUIET_TIME: Duration = Duration::from_millis(1000);
/// Lines of log that may wait to be shown.
const LOG_LINES: usize = 1_000;

/// Arguments of `up`.
#[derive(Debug, Args)]
pub struct UpArguments {
    /// Which configuration.
    #[command(flatten)]
    pub configuration: Configuration,
    /// What ends the run, and what is recorded of it.
    #[command(flatten)]
    pub options: RunOptions,
}

/// Runs `flockeye up`.
///
/// # Errors
/// The configuration is wrong, the instance is taken, memory is short, or a stage cannot work.
pub fn run(arguments: &UpArguments) -> anyhow::Result<()> {
    let stopping = signals::stop_flag()?;
    let pipeline = arguments.configuration.load()?;
    run_pipeline(&pipeline, &arguments.options, &mut Screen::new(), &stopping).map(drop)
}

/// Runs a pipeline until its source ends, the options end it or `stopping` is raised.
///
/// # Errors
/// As [`run`].
pub fn run_pipeline(
    pipeline: &Pipeline,
    options: &RunOptions,
    screen: &mut Screen,
    stopping: &AtomicBool,
) -> anyhow::Result<RunSummary> {
    set_log_level(LogLevel::Fatal);
    let resolved = Resolved::of(pipeline.clone())?;
    // The stages read both. They are checked here too, so that an error is reported once and first.
    resolved.mask()?;
    Dictionary::of(&resolved.bodies)?;
    let budget = Budget::of(&resolved);
    let instance = Instance::named(&pipeline.instance.0);
    let ownership = instance.take()?;
    let (free, total) = shared_memory_space().context("cannot look at /dev/shm")?;
    budget.check(free, total)?;
    instance.write_configuration(pipeline)?;
    let mut supervisor = Supervisor::new(options, &resolved, &instance, budget, screen)?;
    supervisor.start()?;
    let outcome = supervisor.watch(stopping);
    supervisor.stop();
    let summary = supervisor.finish(ownership)?;
    outcome.map(|()| summary)
}

/// Starts the processes of a run, watches them and stops them.
struct Supervisor<'a> {
    duration: Option<Duration>,
    // Dropped in this order: subscribers before the services, the services before the node.
    messages: RunLog,
    ports: Option<Ports>,
    _services: Vec<TopicServices>,
    node: Rc<Node<ipc::Service>>,
    source: Process,
    others: Vec<Process>,
    log: Receiver<LogLine>,
    screen: &'a mut Screen,
    started: Instant,
    next_show: Instant,
}

impl<'a> Supervisor<'a> {
    fn new(
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
        let services = create_all_services(&node, &budget)?;
        let mut ports = Ports::new(node.clone(), budget, Rc::new(Counters::default()));
        let (sender, log) = sync_channel(LOG_LINES);
        let pipeline = &resolved.pipeline;
        let process = |stage: StageName, replica| {
            let configuration = pipeline.stages.of(stage);
            Process::new(stage, replica, configuration, instance.folder(), sender.clone())
        };
        // Against the dataflow, so that a reader is there before what writes to it.
        let consumers = StageName::ALL.into_iter().rev().filter(|stage| !stage.is_source());
        let others = consumers
            .filter(|&stage| pipeline.runs(stage))
            .flat_map(|stage| (0..pipeline.replicas(stage)).map(move |replica| (stage, replica)))
            .map(|(stage, replica)| process(stage, replica))
            .collect::<anyhow::Result<Vec<_>>>()?;
        let now = Instant::now();
        Ok(Self {
            duration: options.duration,
            messages: RunLog::open(resolved, options, &mut ports)?,
            ports: Some(ports),
            _services: services,
            node,
            source: process(pipeline.source_stage(), 0)?,
            others,
            log,
            screen,
            started: now,
            next_show: now,
        })
    }

    /// Starts the consumers; the source follows when they are ready.
    fn start(&mut self) -> anyhow::Result<()> {
        self.others.iter_mut().try_for_each(Process::start)
    }

    /// Watches everything until it is time to stop.
    fn watch(&mut self, stopping: &AtomicBool) -> anyhow::Result<()> {
        let Some(ports) = self.ports.take() else { return Ok(()) };
        let mut source_started: Option<Instant> = None;
        let outcome = ports.attend(|| {
            self.messages.receive()?;
            self.show_log();
            self.look_after_processes()?;
            if source_started.is_none()
                && (self.all_are_ready() || self.started.elapsed() > READY_TIME)
            {
                self.source.start()?;
                source_started = Some(Instant::now());
                self.messages.expect_tracks();
            }
            let time_is_up = self.duration.is_some_and(|duration| {
                source_started.is_some_and(|start| start.elapsed() >= duration)
            });
            let is_complete = self.messages.is_complete();
            if stopping.load(Ordering::Relaxed) || time_is_up || is_complete || self.is_at_end() {
                return Ok(None);
            }
            self.show();
            Ok(Some(Duration::from_millis(20)))
        });
        self.ports = Some(ports);
        outcome
    }

    /// Whether every stage has opened what it needs. A degraded stage counts: it waits for something
    /// outside, such as a gateway for its network port.
    fn all_are_ready(&self) -> bool {
        self.others.iter().all(|process| {
            let state = self.messages.state_of(process.stage.name(), process.replica);
            matches!(state, Some(StageState::Ready | StageState::Degraded))
        })
    }

    fn is_at_end(&self) -> bool {
        self.messages.state_of(self.source.stage.name(), 0) == Some(StageState::Finished)
            && self.messages.quiet_time() > QUIET_TIME
    }

    fn look_after_processes(&mut self) -> anyhow::Result<()> {
        let now_ns = clock::monotonic_ns();
        for process in self.others.iter_mut().chain([&mut self.source]) {
            let silence_ns = process.pid().and_then(|pid| {
                let stage = process.stage.name();
                self.messages.dashboard.silence_ns(stage, process.replica, pid, now_ns)
            });
            if silence_ns.is_some_and(|silence_ns| silence_ns > HUNG_NS) {
                self.screen.line(&format!("{} hangs and is killed", process.label()));
                process.signal(Signal::KILL);
            }
            let node = &self.node;
            let change = process.attend(|| {
                // The dead process's ports are freed before its successor asks for its own.
                node.blocking_cleanup_dead_nodes(Duration::from_secs(1));
            })?;
            match change {
                ProcessChange::None => {}
                ProcessChange::Restarted => {
                    self.screen.line(&format!("{} is started again", process.label()))
                }
                ProcessChange::Ended { how, is_hopeless, retry_in } => {
                    let label = process.label();
                    if is_hopeless && process.generation == 0 {
                        // Its last lines say why, and may not have arrived yet.
                        std::thread::sleep(Duration::from_millis(50));
                        anyhow::bail!("{label} cannot start; its reason is above");
                    }
                    match retry_in {
                        Some(wait) => self.screen.line(&format!(
                            "{label} {how}; it is started again in {:.1} s",
                            wait.as_secs_f64()
                        )),
                        None => {
                            anyhow::bail!(
                                "{label} {how}, and its restart policy does not start it again"
                            )
                        }
                    }
                }
            }
        }
        Ok(())
    }

    fn show_log(&mut self) {
        while let Ok(LogLine { stage, text }) = self.log.try_recv() {
            self.screen
                .line(&format!("{:>8.3} {stage:<14} {text}", self.started.elapsed().as_secs_f64()));
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
            if self.messages.dashboard.frames_ended() > 0 {
                self.screen.line(&self.messages.dashboard.line(now_ns));
            }
            self.next_show = Instant::now() + Duration::from_secs(1);
        }
    }

    /// Stops every stage: asks first, then kills.
    fn stop(&mut self) {
        let mut processes: Vec<_> = self.others.iter_mut().chain([&mut self.source]).collect();
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
        self.show_log();
    }

    /// Shows the summary, completes the files and frees shared memory.
    fn finish(mut self, ownership: Ownership) -> anyhow::Result<RunSummary> {
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
