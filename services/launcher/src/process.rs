//! One stage's process: started, restarted after it failed, stopped, and taken over from an earlier
//! launcher.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`child`] | a process that runs, and how it ended |
//! | [`output`] | output of processes, line by line |
//! | [`command`] | how a process is started |
//! | [`keeping`] | processes that fly on when their launcher dies |
//! | [`memo`] | memo of a worker for a later launcher |

mod child;
mod command;
mod keeping;
pub(crate) mod memo;
mod output;

use std::path::Path;
use std::process::Stdio;
use std::sync::mpsc::SyncSender;
use std::time::{Duration, Instant};

use anyhow::Context;
use flockeye_config::{Restart, StageProcess};
use flockeye_runtime::backoff::Backoff;
use rustix::process::{Pid, Signal, kill_process_group};

pub use self::child::End;
use self::child::RunningProcess;
use self::command::{StartPlan, backoff};
use self::output::KeptOutput;
pub(crate) use self::output::LineSink;
pub use self::output::LogLine;

use crate::control::WorkerName;
use crate::heartbeat::Heartbeat;

/// Time for a process to end by itself after SIGTERM.
pub const STOP_TIME: Duration = Duration::from_millis(1400);
/// Deadline within which the system ends a killed process.
pub(crate) const KILL_TIME: Duration = Duration::from_secs(5);

/// Change of a process since the last check.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ProcessChange {
    /// No change.
    None,
    /// The process ended without a request.
    Ended {
        /// Its end.
        end: End,
        /// Time until it is started again; `None`: its restart policy gives it up.
        retry_in: Option<Duration>,
    },
    /// The process ended on request, and is not started again.
    Stopped,
    /// The process was started again, after the caller cleaned up dead nodes.
    Restarted,
}

/// Condition of a process, as far as the launcher decides it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Condition {
    New,
    Running,
    /// The process is started again at this time.
    Waiting(Instant),
    /// The process is started again at this time, after a long rest: its messages were bad
    /// repeatedly.
    Resting(Instant),
    /// The process was ended on request.
    Stopped,
    /// The process failed permanently.
    GivenUp,
}

/// Consequence of a requested end, once the process has ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum EndRequest {
    Nothing,
    Stop,
    Restart,
    /// Start again after this time.
    Rest(Duration),
}

/// A stage's process: its command, its restart policy and its child while it runs.
pub struct Process {
    /// Which worker of which stage.
    pub worker: WorkerName,
    /// Number of replacements so far.
    pub generation: u32,
    /// Times of the replacements for bad messages.
    pub(crate) replaced: Vec<Instant>,
    /// Hang detector for the time in which it sends no health.
    pub(crate) heartbeat: Heartbeat,
    /// Whether it exceeded its start time.
    pub(crate) is_late: bool,
    /// Whether a complaint about it was shown.
    pub(crate) is_silent: bool,
    /// The highest generation that any process of this worker has had.
    used_generations: u32,
    /// Label and destination of its log lines.
    lines: LineSink,
    start: StartPlan,
    restart: Restart,
    backoff: Backoff,
    child: Option<RunningProcess>,
    /// Whether this process writes the worker's memo: it is the one that counts.
    is_remembered: bool,
    kept_output: Option<KeptOutput>,
    condition: Condition,
    end_request: EndRequest,
    kill_at: Option<Instant>,
    started: Instant,
}

impl Process {
    /// Prepares a worker without starting it. With `is_kept` its process flies on when the launcher
    /// dies.
    ///
    /// # Errors
    /// Its program is not there.
    pub fn new(
        worker: WorkerName,
        configuration: &StageProcess,
        folder: &Path,
        log: SyncSender<LogLine>,
        is_kept: bool,
    ) -> anyhow::Result<Self> {
        let start = StartPlan::of(worker.stage, configuration, folder, is_kept)?;
        let lines = LineSink::new(worker.to_string(), log);
        Ok(Self {
            restart: configuration.restart,
            is_remembered: is_kept,
            ..Self::unstarted(worker, 0, start, lines, backoff(configuration.backoff_s))
        })
    }

    /// A process that has not run and is never started again by itself.
    fn unstarted(
        worker: WorkerName,
        generation: u32,
        start: StartPlan,
        lines: LineSink,
        backoff: Backoff,
    ) -> Self {
        Self {
            worker,
            generation,
            replaced: Vec::new(),
            heartbeat: Heartbeat::default(),
            is_late: false,
            is_silent: false,
            used_generations: generation,
            lines,
            start,
            restart: Restart::Never,
            backoff,
            child: None,
            is_remembered: false,
            kept_output: None,
            condition: Condition::New,
            end_request: EndRequest::Nothing,
            kill_at: None,
            started: Instant::now(),
        }
    }

    /// The process that may replace this one: of the next generation, with `command` (empty: the
    /// same), and not yet started. It is never restarted by itself.
    pub(crate) fn successor(&mut self, command: &[String]) -> Self {
        let generation = self.take_generation();
        self.remember();
        self.beside(generation, command, "new")
    }

    /// Another process of the same worker, with `command` (empty: the same).
    fn beside(&self, generation: u32, command: &[String], what: &str) -> Self {
        let mut start = self.start.clone();
        if !command.is_empty() {
            start.program = command.to_vec();
        }
        let lines = self.lines.of_another(format!("{} ({what})", self.worker));
        Self::unstarted(self.worker, generation, start, lines, self.backoff.clone())
    }

    /// Replaces `old`, which is returned and is never started again.
    pub(crate) fn takes_the_place_of(mut self, old: &mut Self) -> Self {
        self.restart = old.restart;
        self.lines.rename(self.worker.to_string());
        self.used_generations = self.used_generations.max(old.used_generations);
        self.backoff.reset();
        self.is_remembered = old.is_remembered;
        self.remember();
        let mut retired = std::mem::replace(old, self);
        retired.restart = Restart::Never;
        retired.is_remembered = false;
        retired.lines.rename(format!("{} (old)", retired.worker));
        retired
    }

    /// Its name in the table and the log.
    pub(crate) fn label(&self) -> String {
        self.lines.label()
    }

    pub(crate) fn command(&self) -> &[String] {
        &self.start.program
    }

    /// Replaces its program and arguments from the next start on. Returns the former ones.
    pub(crate) fn set_command(&mut self, command: Vec<String>) -> Vec<String> {
        std::mem::replace(&mut self.start.program, command)
    }

    /// Its process number while it runs.
    pub fn pid(&self) -> Option<u32> {
        self.child.as_ref().map(RunningProcess::pid)
    }

    pub(crate) fn condition(&self) -> Condition {
        self.condition
    }

    /// Time since it was started or taken over.
    pub(crate) fn age(&self) -> Duration {
        self.started.elapsed()
    }

    /// The generation that the next process of this worker has.
    pub(crate) fn next_generation(&self) -> u32 {
        self.used_generations + 1
    }

    fn take_generation(&mut self) -> u32 {
        self.used_generations += 1;
        self.used_generations
    }

    /// Starts it. The calling thread must live as long as the launcher: the kernel kills a child
    /// with the *thread* that started it.
    ///
    /// # Errors
    /// The system cannot start a process.
    pub fn start(&mut self) -> anyhow::Result<()> {
        self.end_request = EndRequest::Nothing;
        self.condition = Condition::Running;
        self.remember();
        let mut command = self.start.command(self.worker, self.generation);
        let context = || format!("cannot start {}", self.label());
        let (kept_output, child) = if self.start.is_kept {
            let output = self.create_kept_output().with_context(context)?;
            let kept_output = self.open_kept_output();
            command.stdout(output.try_clone().with_context(context)?).stderr(output);
            (kept_output, command.spawn().with_context(context)?)
        } else {
            let child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn();
            let mut child = child.with_context(context)?;
            self.lines.forward_outputs(&mut child);
            (None, child)
        };
        self.child = Some(RunningProcess::Own(child));
        self.kept_output = kept_output;
        self.kill_at = None;
        (self.is_late, self.is_silent) = (false, false);
        self.started = Instant::now();
        Ok(())
    }

    /// Starts it again at once, in a new generation.
    ///
    /// # Errors
    /// As [`Process::start`].
    pub(crate) fn start_again(&mut self) -> anyhow::Result<()> {
        self.generation = self.take_generation();
        self.start()
    }

    /// Requests its end, and kills it after [`STOP_TIME`].
    pub(crate) fn ask_to_stop(&mut self) {
        self.ask(EndRequest::Stop);
        self.remember();
    }

    /// Requests its end, and starts it again at once afterwards.
    pub(crate) fn ask_to_restart(&mut self) {
        self.ask(EndRequest::Restart);
    }

    fn ask(&mut self, request: EndRequest) {
        if self.child.is_some() {
            self.end_request = request;
            self.kill_at = Some(Instant::now() + STOP_TIME);
            self.signal(Signal::TERM);
        } else if request == EndRequest::Restart {
            self.condition = Condition::Waiting(Instant::now());
        } else {
            self.condition = Condition::Stopped;
        }
    }

    /// Kills it, and starts it again after `rest`.
    pub(crate) fn rest(&mut self, rest: Duration) {
        self.ask(EndRequest::Rest(rest));
        self.signal(Signal::KILL);
    }

    /// Checks on it: reaps it if it has ended, starts it again when its wait is over.
    /// `is_finished`: it has reported the end of its input.
    ///
    /// # Errors
    /// It cannot be started again.
    pub fn attend(
        &mut self,
        is_finished: bool,
        before_restart: impl FnOnce(),
    ) -> anyhow::Result<ProcessChange> {
        self.forward_kept_output();
        if let Some(child) = &mut self.child {
            let context = || format!("waiting for {}", self.lines.label());
            let Some(end) = child.end().with_context(context)? else {
                if self.kill_at.is_some_and(|time| Instant::now() >= time) {
                    self.kill_at = None;
                    self.signal(Signal::KILL);
                }
                return Ok(ProcessChange::None);
            };
            self.forget_kept();
            self.child = None;
            return Ok(self.ended(end, is_finished));
        }
        if let Condition::Waiting(until) | Condition::Resting(until) = self.condition
            && Instant::now() >= until
        {
            before_restart();
            self.start_again()?;
            return Ok(ProcessChange::Restarted);
        }
        Ok(ProcessChange::None)
    }

    fn ended(&mut self, end: End, is_finished: bool) -> ProcessChange {
        match std::mem::replace(&mut self.end_request, EndRequest::Nothing) {
            EndRequest::Stop => {
                self.condition = Condition::Stopped;
                return ProcessChange::Stopped;
            }
            EndRequest::Restart => {
                self.condition = Condition::Waiting(Instant::now());
                return ProcessChange::None;
            }
            EndRequest::Rest(rest) => {
                self.condition = Condition::Resting(Instant::now() + rest);
                return ProcessChange::None;
            }
            EndRequest::Nothing => {}
        }
        let has_lived_long = self.started.elapsed() > LONG_LIFE;
        if has_lived_long {
            self.backoff.reset();
        }
        // The exit status has no influence: a stage ends with the pipeline, and SIGTERM from
        // elsewhere is a polite restart.
        let retry_in = wants_restart(self.restart, is_finished).then(|| match has_lived_long {
            true => Duration::ZERO,
            false => self.backoff.after_failure(),
        });
        self.condition = match retry_in {
            Some(wait) => Condition::Waiting(Instant::now() + wait),
            None => Condition::GivenUp,
        };
        ProcessChange::Ended { end, retry_in }
    }

    /// Sends a signal to it and to every process that it has started.
    pub fn signal(&self, signal: Signal) {
        if let Some(pid) = self.pid() {
            signal_group(pid, signal, &self.label());
        }
    }

    /// Whether it has ended. From now on it is not started again.
    pub(crate) fn has_ended(&mut self) -> bool {
        if matches!(self.condition, Condition::Waiting(_) | Condition::Resting(_)) {
            self.condition = Condition::Stopped;
        }
        let has_ended = match &mut self.child {
            None => true,
            Some(child) => matches!(child.end(), Ok(Some(_)) | Err(_)),
        };
        if has_ended {
            self.forget_kept();
        }
        has_ended
    }
}

/// Sends a signal to the process of this number and to every process that it has started. `label`
/// is its name in the log.
pub(crate) fn signal_group(pid: u32, signal: Signal, label: &str) {
    if let Some(pid) = Pid::from_raw(pid.cast_signed())
        && let Err(error) = kill_process_group(pid, signal)
    {
        // It may have ended in between.
        tracing::debug!("signal to {label}: {error}");
    }
}

/// Whether a process that ended without a request is started again.
fn wants_restart(policy: Restart, is_finished: bool) -> bool {
    match policy {
        Restart::Never => false,
        Restart::OnFailure => !is_finished,
        Restart::Always => true,
    }
}

/// Minimum life of a process that did not fail at its start, so that it is started again at once.
/// Starting one of our stages costs up to 0.3 s of a processor (a simulator more). One that always
/// ends after this time takes a tenth of it.
const LONG_LIFE: Duration = Duration::from_secs(3);

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use std::sync::mpsc::sync_channel;

    #[test]
    fn policies_decide_on_restarts() {
        for (policy, wanted) in [
            (Restart::Never, [false, false]),
            (Restart::OnFailure, [true, false]),
            (Restart::Always, [true, true]),
        ] {
            assert_eq!([false, true].map(|finished| wants_restart(policy, finished)), wanted);
        }
    }

    #[test]
    fn generations_are_never_used_twice() {
        let (log, _kept) = sync_channel(1);
        let configuration = StageProcess { command: vec!["old".to_owned()], ..Default::default() };
        let worker = "detection.1".parse().unwrap();
        let mut process = Process::new(worker, &configuration, Path::new("/"), log, false).unwrap();
        let given_up = process.successor(&[]);
        assert_eq!((given_up.generation, given_up.command()), (1, &["old".to_owned()][..]));
        let new = process.successor(&["new".to_owned()]);
        assert_eq!(new.generation, 2);
        let retired = new.takes_the_place_of(&mut process);
        assert_eq!(
            (process.label().as_str(), process.command()),
            ("detection.1", &["new".to_owned()][..])
        );
        assert_eq!((retired.label().as_str(), retired.generation), ("detection.1 (old)", 0));
        assert_eq!(process.successor(&[]).generation, 3);
    }
}
