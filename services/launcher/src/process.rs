//! One stage's process: started, restarted after it failed, stopped, never an orphan.

use std::io::{BufRead, BufReader, Read};
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::mpsc::SyncSender;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::Context;
use flockeye_config::{Restart, Scheduling, StageInfo, StageProcess};
use flockeye_contract::StageName;
use flockeye_runtime::backoff::Backoff;
use flockeye_runtime::instance::{
    FOLDER_VARIABLE, GENERATION_VARIABLE, REPLICA_VARIABLE, STAGE_VARIABLE,
};
use flockeye_runtime::scheduling::SchedulingPolicy;
use rustix::process::{Pid, Signal, kill_process_group};

use crate::complaints::Replacements;
use crate::control::Worker;
use crate::heartbeat::Heartbeat;

/// How long a process gets to end by itself after SIGTERM.
pub const STOP_TIME: Duration = Duration::from_millis(1400);

/// A line that a stage wrote.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LogLine {
    /// The stage, with the worker's number if there are several.
    pub stage: String,
    /// What it wrote.
    pub text: String,
}

/// What happened to a process since the last check.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ProcessChange {
    /// Nothing.
    None,
    /// It ended without being asked to.
    Ended {
        /// How it ended, in words.
        how: String,
        /// Whether its exit status says that another attempt is useless.
        is_hopeless: bool,
        /// How long until it is started again; `None`: its restart policy gives it up.
        retry_in: Option<Duration>,
    },
    /// It ended as it was asked to, and stays so.
    Stopped,
    /// It was started again, after the caller cleaned up dead nodes.
    Restarted,
}

/// What a process is doing, as far as the launcher decides it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Condition {
    /// Not yet started.
    New,
    /// It runs.
    Running,
    /// It is started again at this time.
    Waiting(Instant),
    /// It was ended on demand.
    Stopped,
    /// It failed for good.
    GivenUp,
}

/// What a running process was asked to do by SIGTERM.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Asked {
    Nothing,
    Stop,
    Restart,
}

/// A stage's process: its command, its restart policy and its child while it runs.
pub struct Process {
    /// Which worker of which stage.
    pub worker: Worker,
    /// How often it was replaced.
    pub generation: u32,
    /// Whether its messages were bad before.
    pub replacements: Replacements,
    /// What the system says of it while it sends no health.
    pub heartbeat: Heartbeat,
    /// Whether its start was found to take too long.
    pub is_late: bool,
    /// Whether it was found to answer nothing.
    pub is_silent: bool,
    /// The highest generation that any process of this worker has had.
    used_generations: u32,
    /// Its name. The threads that pass its lines on read it too: a swap changes it.
    label: Arc<Mutex<String>>,
    command: Vec<String>,
    folder: PathBuf,
    restart: Restart,
    backoff: Backoff,
    child: Option<Child>,
    condition: Condition,
    asked: Asked,
    kill_at: Option<Instant>,
    started: Instant,
    /// Its scheduling and its processors, as arguments of `exec-stage`.
    scheduling: Vec<String>,
    log: SyncSender<LogLine>,
}

impl Process {
    /// Prepares a worker without starting it.
    ///
    /// # Errors
    /// Its program is not there.
    pub fn new(
        worker: Worker,
        configuration: &StageProcess,
        folder: &Path,
        log: SyncSender<LogLine>,
    ) -> anyhow::Result<Self> {
        Ok(Self {
            worker,
            generation: 0,
            replacements: Replacements::default(),
            heartbeat: Heartbeat::default(),
            is_late: false,
            is_silent: false,
            used_generations: 0,
            label: Arc::new(Mutex::new(worker.to_string())),
            command: program(worker.stage.name(), configuration)?,
            scheduling: scheduling_arguments(worker.stage, configuration),
            folder: folder.to_owned(),
            restart: configuration.restart,
            backoff: backoff(configuration.backoff_s),
            child: None,
            condition: Condition::New,
            asked: Asked::Nothing,
            kill_at: None,
            started: Instant::now(),
            log,
        })
    }

    /// The process that may take the place of this one: of the next generation, with `command` (empty: the
    /// same), and not yet started. It is never restarted by itself.
    pub fn successor(&mut self, command: &[String]) -> Self {
        let generation = self.take_generation();
        Self {
            worker: self.worker,
            generation,
            replacements: Replacements::default(),
            heartbeat: Heartbeat::default(),
            is_late: false,
            is_silent: false,
            used_generations: generation,
            label: Arc::new(Mutex::new(format!("{} (new)", self.worker))),
            command: if command.is_empty() { self.command.clone() } else { command.to_vec() },
            scheduling: self.scheduling.clone(),
            folder: self.folder.clone(),
            restart: Restart::Never,
            backoff: self.backoff.clone(),
            child: None,
            condition: Condition::New,
            asked: Asked::Nothing,
            kill_at: None,
            started: Instant::now(),
            log: self.log.clone(),
        }
    }

    /// Takes the place of `old`, which is returned and is never started again.
    pub fn takes_the_place_of(mut self, old: &mut Self) -> Self {
        self.restart = old.restart;
        self.rename(self.worker.to_string());
        self.used_generations = self.used_generations.max(old.used_generations);
        self.backoff.reset();
        let mut retired = std::mem::replace(old, self);
        retired.restart = Restart::Never;
        retired.rename(format!("{} (old)", retired.worker));
        retired
    }

    /// Its name in the table and the log.
    pub fn label(&self) -> String {
        locked(&self.label)
    }

    fn rename(&self, name: String) {
        *self.label.lock().unwrap_or_else(PoisonError::into_inner) = name;
    }

    /// Its program and arguments.
    pub fn command(&self) -> &[String] {
        &self.command
    }

    /// Replaces its program and arguments from the next start on, and returns those of before.
    pub fn set_command(&mut self, command: Vec<String>) -> Vec<String> {
        std::mem::replace(&mut self.command, command)
    }

    /// Its process number while it runs.
    pub fn pid(&self) -> Option<u32> {
        self.child.as_ref().map(Child::id)
    }

    /// What it is doing.
    pub fn condition(&self) -> Condition {
        self.condition
    }

    /// How long ago it was started.
    pub fn age(&self) -> Duration {
        self.started.elapsed()
    }

    fn take_generation(&mut self) -> u32 {
        self.used_generations += 1;
        self.used_generations
    }

    /// Starts it. The calling thread must live as long as the launcher, because the kernel kills a
    /// child with the *thread* that started it.
    ///
    /// # Errors
    /// The system cannot start a process.
    pub fn start(&mut self) -> anyhow::Result<()> {
        // Not by its path: an update may have put another file there.
        let mut command = Command::new("/proc/self/exe");
        if std::env::var_os("XDG_RUNTIME_DIR").is_none() {
            // Graphics drivers warn without one.
            command.env("XDG_RUNTIME_DIR", &self.folder);
        }
        let mut child = command
            .args(["exec-stage", "--parent", &std::process::id().to_string()])
            .args(&self.scheduling)
            .arg("--")
            .args(&self.command)
            .env(FOLDER_VARIABLE, &self.folder)
            .env(STAGE_VARIABLE, self.worker.stage.name())
            .env(REPLICA_VARIABLE, self.worker.replica.to_string())
            .env(GENERATION_VARIABLE, self.generation.to_string())
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .process_group(0)
            .spawn()
            .with_context(|| format!("cannot start {}", self.label()))?;
        if let Some(output) = child.stdout.take() {
            self.forward(output);
        }
        if let Some(output) = child.stderr.take() {
            self.forward(output);
        }
        self.child = Some(child);
        self.condition = Condition::Running;
        self.asked = Asked::Nothing;
        self.kill_at = None;
        (self.is_late, self.is_silent) = (false, false);
        self.started = Instant::now();
        Ok(())
    }

    /// Starts it again at once, in a new generation.
    ///
    /// # Errors
    /// As [`Process::start`].
    pub fn start_again(&mut self) -> anyhow::Result<()> {
        self.generation = self.take_generation();
        self.start()
    }

    /// Forwards a stream line by line, from a thread of its own that ends with the stream.
    fn forward(&self, output: impl Read + Send + 'static) {
        let (label, log) = (self.label.clone(), self.log.clone());
        std::thread::spawn(move || {
            for line in BufReader::new(output).split(b'\n') {
                let Ok(line) = line else { break };
                let text = String::from_utf8_lossy(&line).trim_end().to_owned();
                // A slow launcher must not block the stage: the line is dropped instead.
                drop(log.try_send(LogLine { stage: locked(&label), text }));
            }
        });
    }

    /// Asks it to end, and kills it if it does not in [`STOP_TIME`].
    pub fn ask_to_stop(&mut self) {
        self.ask(Asked::Stop);
    }

    /// Asks it to end, and starts it again at once when it has.
    pub fn ask_to_restart(&mut self) {
        self.ask(Asked::Restart);
    }

    fn ask(&mut self, asked: Asked) {
        if self.child.is_some() {
            self.asked = asked;
            self.kill_at = Some(Instant::now() + STOP_TIME);
            self.signal(Signal::TERM);
        } else if asked == Asked::Restart {
            self.condition = Condition::Waiting(Instant::now());
        } else {
            self.condition = Condition::Stopped;
        }
    }

    /// Never starts it again by itself, and kills it if it runs.
    pub fn give_up(&mut self) {
        self.ask_to_stop();
        self.signal(Signal::KILL);
        self.condition = Condition::GivenUp;
    }

    /// Checks on it: reaps it if it has ended, starts it again when its wait is over. `is_finished` says
    /// whether it has reported that its input is at its end.
    ///
    /// # Errors
    /// It cannot be started again.
    pub fn attend(
        &mut self,
        is_finished: bool,
        before_restart: impl FnOnce(),
    ) -> anyhow::Result<ProcessChange> {
        if let Some(child) = &mut self.child {
            let Some(status) =
                child.try_wait().with_context(|| format!("waiting for {}", self.label()))?
            else {
                if self.kill_at.is_some_and(|time| Instant::now() >= time) {
                    self.kill_at = None;
                    self.signal(Signal::KILL);
                }
                return Ok(ProcessChange::None);
            };
            self.child = None;
            return Ok(self.ended(status, is_finished));
        }
        if let Condition::Waiting(until) = self.condition
            && Instant::now() >= until
        {
            before_restart();
            self.start_again()?;
            return Ok(ProcessChange::Restarted);
        }
        Ok(ProcessChange::None)
    }

    fn ended(&mut self, status: ExitStatus, is_finished: bool) -> ProcessChange {
        match std::mem::replace(&mut self.asked, Asked::Nothing) {
            Asked::Stop => {
                if self.condition != Condition::GivenUp {
                    self.condition = Condition::Stopped;
                }
                return ProcessChange::Stopped;
            }
            Asked::Restart => {
                self.condition = Condition::Waiting(Instant::now());
                return ProcessChange::None;
            }
            Asked::Nothing => {}
        }
        let has_lived_long = self.started.elapsed() > LONG_LIFE;
        if has_lived_long {
            self.backoff.reset();
        }
        // Whatever its status is: a stage ends with the pipeline, and SIGTERM from elsewhere is a polite
        // restart.
        let retry_in = wants_restart(self.restart, is_finished).then(|| match has_lived_long {
            true => Duration::ZERO,
            false => self.backoff.after_failure(),
        });
        self.condition = match retry_in {
            Some(wait) => Condition::Waiting(Instant::now() + wait),
            None => Condition::GivenUp,
        };
        let is_hopeless = status.code() == Some(i32::from(flockeye_runtime::stage::CANNOT_START));
        ProcessChange::Ended { how: describe(status), is_hopeless, retry_in }
    }

    /// Sends a signal to it and to every process that it has started.
    pub fn signal(&self, signal: Signal) {
        let pid = self.pid().and_then(|pid| Pid::from_raw(pid.cast_signed()));
        if let Some(pid) = pid
            && let Err(error) = kill_process_group(pid, signal)
        {
            // It may have ended in between.
            tracing::debug!("signal to {}: {error}", self.label());
        }
    }

    /// Whether it has ended. It is not started again from now on.
    pub fn has_ended(&mut self) -> bool {
        if matches!(self.condition, Condition::Waiting(_)) {
            self.condition = Condition::Stopped;
        }
        match &mut self.child {
            None => true,
            Some(child) => matches!(child.try_wait(), Ok(Some(_)) | Err(_)),
        }
    }
}

/// A thread that panicked while it held the lock left the text whole.
fn locked(label: &Mutex<String>) -> String {
    label.lock().unwrap_or_else(PoisonError::into_inner).clone()
}

/// Program and arguments of a stage: as configured, or the one beside the launcher.
fn program(stage: &str, configuration: &StageProcess) -> anyhow::Result<Vec<String>> {
    if !configuration.command.is_empty() {
        return Ok(configuration.command.clone());
    }
    let own = std::env::current_exe().context("cannot find the flockeye program")?;
    let path = own.with_file_name(format!("flockeye-{stage}"));
    anyhow::ensure!(
        path.exists(),
        "the program of {stage} is not at {}. Cure: build the whole workspace (cargo build --release --workspace)",
        path.display()
    );
    Ok(vec![path.to_string_lossy().into_owned()])
}

/// Whether a process is started again that ended without being asked to.
fn wants_restart(policy: Restart, is_finished: bool) -> bool {
    match policy {
        Restart::Never => false,
        Restart::OnFailure => !is_finished,
        Restart::Always => true,
    }
}

fn describe(status: ExitStatus) -> String {
    match (status.code(), status.signal()) {
        (Some(code), _) => format!("ended with status {code}"),
        (None, Some(signal)) => format!("was killed by signal {signal}"),
        (None, None) => "ended".to_owned(),
    }
}

/// A process that lived this long did not fail at its start, and is started again at once. Starting one of our
/// stages costs up to 0.3 s of a processor (a simulator more), so one that always ends after this takes a tenth
/// of it.
const LONG_LIFE: Duration = Duration::from_secs(3);

fn backoff([first_s, longest_s]: [f64; 2]) -> Backoff {
    let wait = |s: f64| Duration::try_from_secs_f64(s).unwrap_or(Duration::from_secs(1));
    Backoff::new(wait(first_s), wait(longest_s))
}

/// The arguments of `exec-stage` that say how and on which processors a stage runs.
fn scheduling_arguments(stage: StageName, configuration: &StageProcess) -> Vec<String> {
    let usual = StageInfo::of(stage).nice;
    let mut arguments = vec![format!("--nice={}", configuration.nice.unwrap_or(usual))];
    if !configuration.cpus.is_empty() {
        let cpus: Vec<String> = configuration.cpus.iter().map(u32::to_string).collect();
        arguments.push(format!("--cpus={}", cpus.join(",")));
    }
    let policy = match configuration.scheduling {
        Scheduling::Normal => return arguments,
        Scheduling::Batch => SchedulingPolicy::Batch,
        Scheduling::Idle => SchedulingPolicy::Idle,
        Scheduling::Fifo => SchedulingPolicy::Fifo,
        Scheduling::RoundRobin => SchedulingPolicy::RoundRobin,
    };
    arguments.push(format!("--scheduling={policy}"));
    arguments.push(format!("--priority={}", configuration.priority));
    arguments
}

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
        assert_eq!(describe(ExitStatus::from_raw(9)), "was killed by signal 9");
    }

    #[test]
    fn generations_are_never_used_twice() {
        let (log, _kept) = sync_channel(1);
        let configuration = StageProcess { command: vec!["old".to_owned()], ..Default::default() };
        let worker = "detection.1".parse().unwrap();
        let mut process = Process::new(worker, &configuration, Path::new("/"), log).unwrap();
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
