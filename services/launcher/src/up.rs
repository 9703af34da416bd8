//! `flockeye up`: runs a pipeline until it ends.

use std::collections::BTreeSet;
use std::path::Path;
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, sync_channel};
use std::time::{Duration, Instant};

use anyhow::Context;
use flockeye_config::{Pipeline, Resolved};
use flockeye_contract::{Detections, FrameStamp, Healths, StageName, StageState, Tracks, Truths};
use flockeye_dictionary::Dictionary;
use flockeye_runtime::clock;
use flockeye_runtime::health::Counters;
use flockeye_runtime::instance::{Instance, Ownership};
use flockeye_runtime::memory::{Budget, shared_memory_space};
use flockeye_runtime::ports::{Ports, Subscriber, TopicServices, create_all_services};
use iceoryx2::prelude::*;
use rustix::process::Signal;

use crate::calibrate::SeenRays;
use crate::cli::Up;
use crate::dashboard::Dashboard;
use crate::process::{Change, LogLine, Process};
use crate::record::{PoseRow, Recorder, TruthRow};
use crate::screen::Screen;
use crate::sweep::{SweepReport, SweepWatch};

/// How long stages get to stop by themselves; with what follows, Ctrl-C takes under 2 seconds.
const STOP_TIME: Duration = Duration::from_millis(1400);
/// A source starts when all others are ready, or after this (a foreign stage may send no health).
const READY_TIME: Duration = Duration::from_secs(10);
/// A stage that has sent health before and sends none for this long is hung.
const HUNG_NS: i64 = 15_000_000_000;
/// A recording is at its end when its source says so and no track has come for this long.
const QUIET_TIME: Duration = Duration::from_millis(1000);
/// Lines of log that may wait to be shown.
const LOG_LINES: usize = 1_000;

/// What is asked of a flight beside its configuration.
#[derive(Debug, Clone, Copy, Default)]
pub struct Errand<'a> {
    /// It stops after this long.
    pub duration: Option<Duration>,
    /// It stops after so many frames.
    pub frames: Option<u64>,
    /// Where poses are recorded.
    pub poses: Option<&'a Path>,
    /// Where the truth is recorded.
    pub truth: Option<&'a Path>,
    /// Whether what came of it is kept in memory.
    pub keeps: bool,
    /// Whether the rays of decoded markers are.
    pub keeps_rays: bool,
    /// Whether it is noted how often each part of the sphere is searched.
    pub watches_sweep: bool,
}

/// What came of a flight.
#[derive(Debug, Clone, Default)]
pub struct Flown {
    /// Every pose of the frames that ended; of no other frame.
    pub poses: Vec<PoseRow>,
    /// The truth, if the source has one; also of frames that did not end.
    pub truth: Vec<TruthRow>,
    /// Rays of decoded markers' corners, where they were asked for.
    pub rays: SeenRays,
    /// Numbers of the frames that ended.
    pub frames: BTreeSet<u64>,
    /// From each frame's publication to its end, summed, seconds.
    pub work_s: f64,
    /// From the first frame's end to the last one's, seconds.
    pub ends_s: f64,
    /// When the first frame ended, CLOCK_MONOTONIC, nanoseconds.
    pub first_end_ns: Option<i64>,
    /// How often each part of the sphere was searched, where that was asked for.
    pub sweep: Option<SweepReport>,
}

impl Flown {
    /// A frame has ended.
    fn end(&mut self, stamp: &FrameStamp, now_ns: i64) {
        self.frames.insert(stamp.sequence);
        self.work_s += (now_ns - stamp.published_ns) as f64 * 1e-9;
        self.ends_s = (now_ns - *self.first_end_ns.get_or_insert(now_ns)) as f64 * 1e-9;
    }
}

/// Runs it.
///
/// # Errors
/// The configuration is wrong, the instance is taken, memory is short, or a stage cannot work.
pub fn run(arguments: &Up) -> anyhow::Result<()> {
    let stopping = stopped_by_signals()?;
    let pipeline = arguments.configuration.load()?;
    let errand = Errand {
        duration: arguments.duration,
        poses: arguments.poses.as_deref(),
        truth: arguments.truth.as_deref(),
        ..Errand::default()
    };
    fly(&pipeline, &errand, &mut Screen::new(), &stopping).map(drop)
}

/// A flag that SIGINT, SIGTERM and SIGHUP raise.
///
/// # Errors
/// The system does not let signals be caught.
pub fn stopped_by_signals() -> anyhow::Result<Arc<AtomicBool>> {
    let stopping = Arc::new(AtomicBool::new(false));
    for signal in
        [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM, signal_hook::consts::SIGHUP]
    {
        signal_hook::flag::register(signal, stopping.clone()).context("cannot catch signals")?;
    }
    Ok(stopping)
}

/// Runs a pipeline until its source ends, the errand is done or `stopping` is raised.
///
/// # Errors
/// As [`run`].
pub fn fly(
    pipeline: &Pipeline,
    errand: &Errand<'_>,
    screen: &mut Screen,
    stopping: &AtomicBool,
) -> anyhow::Result<Flown> {
    set_log_level(LogLevel::Fatal);
    let resolved = Resolved::of(pipeline.clone())?;
    // Stages read these too; here a wrong one is reported once, before any process starts.
    resolved.mask()?;
    Dictionary::of(&resolved.bodies)?;
    let budget = Budget::of(pipeline, resolved.largest_view_px());
    let instance = Instance::named(&pipeline.instance.0);
    let ownership = instance.take()?;
    let (free, total) = shared_memory_space().context("cannot look at /dev/shm")?;
    budget.check(free, total)?;
    instance.write_configuration(pipeline)?;
    let mut launcher = Launcher::new(errand, &resolved, &instance, budget, screen)?;
    launcher.start()?;
    let outcome = launcher.watch(stopping);
    launcher.stop();
    let flown = launcher.finish(ownership)?;
    outcome.map(|()| flown)
}

struct Launcher<'a> {
    errand: Errand<'a>,
    // Ports go before the services, the services before the node.
    tracks: Subscriber<Tracks>,
    healths: Subscriber<Healths>,
    truths: Subscriber<Truths>,
    detections: Option<Subscriber<Detections>>,
    sweep: Option<SweepWatch>,
    ports: Option<Ports>,
    _services: Vec<TopicServices>,
    node: Rc<Node<ipc::Service>>,
    source: Process,
    others: Vec<Process>,
    log: Receiver<LogLine>,
    screen: &'a mut Screen,
    dashboard: Dashboard,
    poses: Option<Recorder<PoseRow>>,
    truth: Option<Recorder<TruthRow>>,
    flown: Flown,
    started: Instant,
    last_track: Instant,
    next_show: Instant,
}

impl<'a> Launcher<'a> {
    fn new(
        errand: &Errand<'a>,
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
        // Against the dataflow, so that who reads is there before who writes.
        let consumers = StageName::ALL.into_iter().rev().filter(|stage| !stage.is_source());
        let others = consumers
            .filter(|&stage| pipeline.runs(stage))
            .flat_map(|stage| (0..pipeline.replicas(stage)).map(move |replica| (stage, replica)))
            .map(|(stage, replica)| process(stage, replica))
            .collect::<anyhow::Result<Vec<_>>>()?;
        let now = Instant::now();
        Ok(Self {
            errand: *errand,
            tracks: ports.subscriber()?,
            healths: ports.subscriber()?,
            truths: ports.subscriber()?,
            detections: errand.keeps_rays.then(|| ports.subscriber()).transpose()?,
            sweep: match errand.watches_sweep {
                true => SweepWatch::open(resolved, &mut ports)?,
                false => None,
            },
            ports: Some(ports),
            _services: services,
            node,
            source: process(pipeline.source_stage(), 0)?,
            others,
            log,
            screen,
            dashboard: Dashboard::default(),
            poses: errand.poses.map(Recorder::create).transpose()?,
            truth: errand.truth.map(Recorder::create).transpose()?,
            flown: Flown::default(),
            started: now,
            last_track: now,
            next_show: now,
        })
    }

    /// Starts the consumers; the source follows when they are ready.
    fn start(&mut self) -> anyhow::Result<()> {
        self.others.iter_mut().try_for_each(Process::start)
    }

    /// Looks after everything until it is time to stop.
    fn watch(&mut self, stopping: &AtomicBool) -> anyhow::Result<()> {
        let Some(ports) = self.ports.take() else { return Ok(()) };
        let mut source_started: Option<Instant> = None;
        let outcome = ports.attend(|| {
            self.receive()?;
            self.show_log();
            self.look_after_processes()?;
            if source_started.is_none()
                && (self.all_are_ready() || self.started.elapsed() > READY_TIME)
            {
                self.source.start()?;
                source_started = Some(Instant::now());
                self.last_track = Instant::now();
            }
            let time_is_up = self.errand.duration.is_some_and(|duration| {
                source_started.is_some_and(|start| start.elapsed() >= duration)
            });
            let is_enough =
                self.errand.frames.is_some_and(|frames| self.dashboard.frames_ended() >= frames);
            if stopping.load(Ordering::Relaxed) || time_is_up || is_enough || self.is_at_end() {
                return Ok(None);
            }
            self.show();
            Ok(Some(Duration::from_millis(20)))
        });
        self.ports = Some(ports);
        outcome
    }

    fn receive(&mut self) -> anyhow::Result<()> {
        while let Some(message) = self.healths.receive()? {
            self.dashboard.health(&message.header);
        }
        while let Some(message) = self.truths.receive()? {
            self.dashboard.truth(&message.header, message.items());
            for row in message.items().iter().map(|body| TruthRow::of(&message.header, body)) {
                if let Some(recorder) = &mut self.truth {
                    recorder.add(&row)?;
                }
                if self.errand.keeps {
                    self.flown.truth.push(row);
                }
            }
        }
        if let Some(detections) = &mut self.detections {
            while let Some(message) = detections.receive()? {
                self.flown.rays.add(&message.header, message.items());
            }
        }
        if let Some(sweep) = &mut self.sweep {
            sweep.receive()?;
        }
        while let Some(message) = self.tracks.receive()? {
            let stamp = message.header.stamp;
            let is_last = message.header.is_last != 0;
            self.last_track = Instant::now();
            let now_ns = clock::monotonic_ns();
            self.dashboard.tracks(&stamp, message.items(), is_last, now_ns);
            for row in message.items().iter().filter_map(|track| PoseRow::of(&stamp, track)) {
                if let Some(recorder) = &mut self.poses {
                    recorder.add(&row)?;
                }
                if self.errand.keeps {
                    self.flown.poses.push(row);
                }
            }
            let is_more = |frames| (self.flown.frames.len() as u64) < frames;
            if is_last && self.errand.keeps && self.errand.frames.is_none_or(is_more) {
                self.flown.end(&stamp, now_ns);
            }
        }
        Ok(())
    }

    /// Whether every stage has opened what it needs. One that waits for something outside, a
    /// gateway without its port, say, is waited for by nobody.
    fn all_are_ready(&self) -> bool {
        self.others.iter().all(|process| {
            let state = self.dashboard.state_of(process.stage.name(), process.replica);
            matches!(state, Some(StageState::Ready | StageState::Degraded))
        })
    }

    fn is_at_end(&self) -> bool {
        self.dashboard.state_of(self.source.stage.name(), 0) == Some(StageState::Finished)
            && self.last_track.elapsed() > QUIET_TIME
    }

    fn look_after_processes(&mut self) -> anyhow::Result<()> {
        let now_ns = clock::monotonic_ns();
        for process in self.others.iter_mut().chain([&mut self.source]) {
            let silence_ns = process.pid().and_then(|pid| {
                self.dashboard.silence_ns(process.stage.name(), process.replica, pid, now_ns)
            });
            if silence_ns.is_some_and(|silence_ns| silence_ns > HUNG_NS) {
                self.screen.line(&format!("{} is hung: it is ended", process.label()));
                process.signal(Signal::KILL);
            }
            let node = &self.node;
            let change = process.attend(|| {
                // The dead process's ports are freed before its successor asks for its own.
                node.blocking_cleanup_dead_nodes(Duration::from_secs(1));
            })?;
            match change {
                Change::None => {}
                Change::Restarted => {
                    self.screen.line(&format!("{} is started again", process.label()))
                }
                Change::Ended { how, is_hopeless, retry_in } => {
                    let label = process.label();
                    if is_hopeless && process.generation == 0 {
                        // What it wrote last says why, and may still be on its way.
                        std::thread::sleep(Duration::from_millis(50));
                        anyhow::bail!("{label} cannot start; its reason is above");
                    }
                    match retry_in {
                        Some(wait) => self.screen.line(&format!(
                            "{label} {how}; it is started again in {:.1} s",
                            wait.as_secs_f64()
                        )),
                        None => {
                            anyhow::bail!("{label} {how}, and its restart policy leaves it at that")
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
            self.screen.table(&self.dashboard.table(now_ns));
            self.next_show = Instant::now() + Duration::from_millis(200);
        } else {
            if self.dashboard.frames_ended() > 0 {
                self.screen.line(&self.dashboard.line(now_ns));
            }
            self.next_show = Instant::now() + Duration::from_secs(1);
        }
    }

    /// Stops every stage: politely, then not.
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
                self.screen.line(&format!("{} does not stop: it is ended", process.label()));
                process.signal(Signal::KILL);
                while !process.has_ended() {
                    std::thread::sleep(Duration::from_millis(1));
                }
            }
        }
        self.show_log();
    }

    /// Says what it came to, and gives everything back.
    fn finish(mut self, ownership: Ownership) -> anyhow::Result<Flown> {
        self.receive()?;
        if self.dashboard.frames_ended() > 0 {
            self.screen.line(&self.dashboard.summary());
        } else {
            self.screen.line("no frame was searched to its end");
        }
        if let Some(recorder) = self.poses.take() {
            recorder.finish()?;
        }
        if let Some(recorder) = self.truth.take() {
            recorder.finish()?;
        }
        let mut flown = std::mem::take(&mut self.flown);
        flown.sweep = self.sweep.as_ref().and_then(SweepWatch::report);
        flown.poses.retain(|row| flown.frames.contains(&row.frame));
        // Shared memory is unmapped before its files are removed.
        drop(self);
        drop(ownership);
        Ok(flown)
    }
}
