//! The loop of every stage: wait for an input, step, send health, drain on SIGTERM, stop.

use std::process::ExitCode;
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::Context as _;
use flockeye_contract::{Complaints, Health, Healths, StageName, StageState};
use iceoryx2::prelude::*;

use crate::findings::{self, EXAMINE, Finding};
use crate::health::{Counters, HEALTH_PERIOD, Identity, SharedCounters};
use crate::instance::{GENERATION_VARIABLE, Instance, REPLICA_VARIABLE};
use crate::listening::Listening;
use crate::memory::Budget;
use crate::ports::{Ports, Publisher};
use crate::saved_state::SavedStates;
use crate::{clock, logs};
use flockeye_config::{Pipeline, Resolved};

/// A stage of the dataflow: its inputs, its outputs, and its state between frames.
pub trait Stage: Sized {
    /// Its name in pipeline.yaml.
    const NAME: &'static str;

    /// Opens its ports and devices.
    ///
    /// # Errors
    /// Any failure that keeps it from working; the process ends with the message.
    fn open(context: &Context, ports: &mut Ports) -> anyhow::Result<Self>;

    /// Handles waiting inputs, and returns the time of the next call. It is also called whenever an
    /// input has a message. It must not block for long, because health is sent between two calls.
    ///
    /// # Errors
    /// Only failures that keep it from working at all. Bad input is refused inside the stage.
    fn step(&mut self) -> anyhow::Result<Step>;

    /// Examines this machine for the requirements of the stage, before a flight. Nothing is opened
    /// for long, and nothing is changed.
    fn examine(_pipeline: &Pipeline) -> Vec<Finding> {
        Vec::new()
    }

    /// Finishes the messages in work. Called once, before the process ends.
    ///
    /// # Errors
    /// The reason why they cannot be finished.
    fn drain(&mut self) -> anyhow::Result<()> {
        Ok(())
    }
}

/// Time of a stage's next call.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Step {
    /// When an input has something.
    Wait,
    /// When an input has something, but no later than at this time of CLOCK_MONOTONIC, nanoseconds.
    WaitUntil(i64),
    /// At once.
    Again,
    /// Its input has ended. The process stays until the signal to stop, so that its last messages
    /// can be read.
    Finished,
}

/// Configuration and identity of a stage's process.
pub struct Context {
    /// The configuration, and the values computed from it.
    pub resolved: Resolved,
    /// Identity of this process.
    pub identity: Identity,
    /// Counters of the stage.
    pub counters: SharedCounters,
    /// Saved states of this worker for its successors.
    pub saved_states: SavedStates,
}

/// Exit status of a stage that could not start, where a restart with the same input cannot help.
pub const CANNOT_START: u8 = 2;

/// The whole `main` of a stage.
pub fn main<S: Stage>() -> ExitCode {
    logs::init();
    let mut arguments = std::env::args_os().skip(1);
    if arguments.next().is_some_and(|word| word == EXAMINE) {
        return match findings::answer(std::io::stdin(), std::io::stdout(), S::examine) {
            Ok(()) => ExitCode::SUCCESS,
            Err(error) => {
                tracing::error!("this machine cannot be examined: {error:#}");
                ExitCode::FAILURE
            }
        };
    }
    let started = StageRuntime::join(S::NAME).and_then(|mut runtime| {
        let stage = S::open(&runtime.context, &mut runtime.ports)?;
        Ok((runtime, stage))
    });
    match started {
        Err(error) => {
            tracing::error!("cannot start: {error:#}");
            ExitCode::from(CANNOT_START)
        }
        Ok((runtime, stage)) => match run(runtime, stage) {
            Ok(()) => ExitCode::SUCCESS,
            Err(error) => {
                tracing::error!("{error:#}");
                ExitCode::FAILURE
            }
        },
    }
}

fn run(mut runtime: StageRuntime, mut stage: impl Stage) -> anyhow::Result<()> {
    runtime.report(StageState::Ready)?;
    runtime.serve(|| stage.step())?;
    runtime.report(StageState::Draining)?;
    stage.drain()
}

/// Runtime of a process that has joined the pipeline as a stage: the duties of every stage.
pub struct StageRuntime {
    /// Configuration and identity.
    pub context: Context,
    /// Its ports.
    pub ports: Ports,
    health: Publisher<Healths>,
    /// Time of the next health report, CLOCK_MONOTONIC, nanoseconds.
    next_health_ns: i64,
    stopping: Arc<AtomicBool>,
}

impl StageRuntime {
    /// Joins the pipeline that the launcher's environment names, and reports the start. From now on
    /// SIGTERM and SIGINT end [`StageRuntime::serve`].
    ///
    /// # Errors
    /// There is no such stage or pipeline, or it has another version of the contract.
    pub fn join(name: &str) -> anyhow::Result<Self> {
        // iceoryx2's results contain the relevant errors; its own log would repeat them.
        set_log_level(LogLevel::Fatal);
        let stopping = Arc::new(AtomicBool::new(false));
        for signal in [signal_hook::consts::SIGTERM, signal_hook::consts::SIGINT] {
            signal_hook::flag::register(signal, stopping.clone())
                .context("cannot catch signals")?;
        }
        let stage_name =
            StageName::from_name(name).with_context(|| format!("{name} is not in the contract"))?;
        let instance = Instance::of_this_process()?;
        let resolved = Resolved::of(instance.pipeline()?)?;
        let identity = Identity {
            stage: name.to_owned(),
            replica: number_from(REPLICA_VARIABLE)?,
            generation: number_from(GENERATION_VARIABLE)?,
        };
        let failure = format!("cannot join the instance '{}'", instance.name());
        let node = instance.create_node(&format!("{name}-{}", identity.replica), &failure)?;
        let budget = Budget::of(&resolved);
        let counters: SharedCounters = Rc::new(Counters::default());
        // Health messages are not counted as the stage's own output.
        let uncounted = Ports::new(node.clone(), budget.clone(), SharedCounters::default());
        let health = uncounted.publisher::<Healths>()?;
        let next_health_ns = send_health(&health, &counters, &identity, StageState::Starting)?;
        let listening =
            Rc::new(Listening::of_stage(stage_name, identity.replica, identity.generation));
        let complaints: Publisher<Complaints> = uncounted.side_publisher()?;
        listening.complain_by(move |complaint| {
            if let Err(error) = complaints.send(complaint, &[]) {
                tracing::debug!("a complaint cannot be sent: {error}");
            }
        });
        let mut ports = Ports::new(node, budget, counters.clone()).listening_to(listening);
        ports.follow_hand_overs()?;
        let saved_states = SavedStates::of(&instance, &identity);
        let context = Context { resolved, identity, counters, saved_states };
        Ok(Self { context, ports, health, next_health_ns, stopping })
    }

    /// Sends health with this state.
    ///
    /// # Errors
    /// The message cannot be sent.
    pub fn report(&mut self, state: StageState) -> anyhow::Result<()> {
        let Context { counters, identity, .. } = &self.context;
        self.next_health_ns = send_health(&self.health, counters, identity, state)?;
        Ok(())
    }

    /// Calls `step` as [`Stage::step`] is called, and sends health in between, until SIGTERM.
    ///
    /// # Errors
    /// Errors of `step`, or of waiting.
    pub fn serve(&mut self, mut step: impl FnMut() -> anyhow::Result<Step>) -> anyhow::Result<()> {
        let Self { context, ports, health, next_health_ns, stopping } = self;
        let send = |state| send_health(health, &context.counters, &context.identity, state);
        let mut state = StageState::Ready;
        ports.attend(|| {
            if stopping.load(Ordering::Relaxed) {
                return Ok(None);
            }
            let step = step()?;
            if step == Step::Finished && state != StageState::Finished {
                state = StageState::Finished;
                *next_health_ns = send(state)?;
            }
            let now_ns = clock::monotonic_ns();
            if now_ns >= *next_health_ns {
                *next_health_ns = send(state)?;
            }
            let longest = clock::until(*next_health_ns, now_ns);
            Ok(Some(match step {
                Step::Again => Duration::ZERO,
                Step::WaitUntil(time_ns) => longest.min(clock::until(time_ns, now_ns)),
                Step::Wait | Step::Finished => longest,
            }))
        })
    }
}

fn number_from(variable: &str) -> anyhow::Result<u32> {
    match std::env::var(variable) {
        Ok(text) => text.parse().with_context(|| format!("{variable} is '{text}', not a number")),
        Err(_) => Ok(0),
    }
}

/// Sends health. Returns the time of the next report, CLOCK_MONOTONIC, nanoseconds.
fn send_health(
    publisher: &Publisher<Healths>,
    counters: &Counters,
    identity: &Identity,
    state: StageState,
) -> anyhow::Result<i64> {
    let report: Health = counters.report(identity, state);
    publisher.send(report, &[])?;
    Ok(report.sent_ns + HEALTH_PERIOD.as_nanos() as i64)
}
