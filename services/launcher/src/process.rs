//! One stage's process: started, restarted after it failed, stopped, never an orphan.

use std::io::{BufRead, BufReader, Read};
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::mpsc::SyncSender;
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
    /// It ended. It is started again after a wait unless that is `None`.
    Ended {
        /// How it ended, in words.
        how: String,
        /// Whether its exit status says that another attempt is useless.
        is_hopeless: bool,
        /// How long until it is started again.
        retry_in: Option<Duration>,
    },
    /// It was started again, after the caller cleaned up dead nodes.
    Restarted,
}

/// A stage's process: its command, its restart policy and its child while it runs.
pub struct Process {
    /// The stage's name in pipeline.yaml.
    pub stage: StageName,
    /// The worker's number, from 0.
    pub replica: u32,
    /// How often it was replaced.
    pub generation: u32,
    label: String,
    command: Vec<String>,
    folder: PathBuf,
    restart: Restart,
    backoff: Backoff,
    child: Option<Child>,
    started: Instant,
    retry_at: Option<Instant>,
    /// Its scheduling and its processors, as arguments of `exec-stage`.
    scheduling: Vec<String>,
    log: SyncSender<LogLine>,
}

impl Process {
    /// Prepares worker `replica` of a stage without starting it.
    pub fn new(
        stage: StageName,
        replica: u32,
        configuration: &StageProcess,
        folder: &Path,
        log: SyncSender<LogLine>,
    ) -> anyhow::Result<Self> {
        let label = match replica {
            0 => stage.name().to_owned(),
            _ => format!("{}.{replica}", stage.name()),
        };
        Ok(Self {
            stage,
            replica,
            generation: 0,
            label,
            command: program(stage.name(), configuration)?,
            scheduling: scheduling_arguments(stage, configuration),
            folder: folder.to_owned(),
            restart: configuration.restart,
            backoff: backoff(configuration.backoff_s),
            child: None,
            started: Instant::now(),
            retry_at: None,
            log,
        })
    }

    /// Its name in the table and the log.
    pub fn label(&self) -> &str {
        &self.label
    }

    /// Its process number while it runs.
    pub fn pid(&self) -> Option<u32> {
        self.child.as_ref().map(Child::id)
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
            .env(STAGE_VARIABLE, self.stage.name())
            .env(REPLICA_VARIABLE, self.replica.to_string())
            .env(GENERATION_VARIABLE, self.generation.to_string())
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .process_group(0)
            .spawn()
            .with_context(|| format!("cannot start {}", self.label))?;
        if let Some(output) = child.stdout.take() {
            self.forward(output);
        }
        if let Some(output) = child.stderr.take() {
            self.forward(output);
        }
        self.child = Some(child);
        self.started = Instant::now();
        self.retry_at = None;
        Ok(())
    }

    /// Forwards a stream line by line, from a thread of its own that ends with the stream.
    fn forward(&self, output: impl Read + Send + 'static) {
        let (stage, log) = (self.label.clone(), self.log.clone());
        std::thread::spawn(move || {
            for line in BufReader::new(output).split(b'\n') {
                let Ok(line) = line else { break };
                let text = String::from_utf8_lossy(&line).trim_end().to_owned();
                // A slow launcher must not block the stage: the line is dropped instead.
                drop(log.try_send(LogLine { stage: stage.clone(), text }));
            }
        });
    }

    /// Checks on it: reaps it if it has ended, starts it again when its wait is over.
    ///
    /// # Errors
    /// It cannot be started again.
    pub fn attend(&mut self, before_restart: impl FnOnce()) -> anyhow::Result<ProcessChange> {
        if let Some(child) = &mut self.child {
            let Some(status) =
                child.try_wait().with_context(|| format!("waiting for {}", self.label))?
            else {
                return Ok(ProcessChange::None);
            };
            self.child = None;
            if self.started.elapsed() > LONG_LIFE {
                self.backoff.reset();
            }
            let retry_in =
                wants_restart(self.restart, status).then(|| self.backoff.after_failure());
            self.retry_at = retry_in.map(|wait| Instant::now() + wait);
            let is_hopeless =
                status.code() == Some(i32::from(flockeye_runtime::stage::CANNOT_START));
            return Ok(ProcessChange::Ended { how: describe(status), is_hopeless, retry_in });
        }
        if self.retry_at.is_some_and(|time| Instant::now() >= time) {
            before_restart();
            self.generation += 1;
            self.start()?;
            return Ok(ProcessChange::Restarted);
        }
        Ok(ProcessChange::None)
    }

    /// Whether it runs, or will again.
    pub fn is_alive(&self) -> bool {
        self.child.is_some() || self.retry_at.is_some()
    }

    /// Sends a signal to it and to every process that it has started.
    pub fn signal(&self, signal: Signal) {
        let pid = self.pid().and_then(|pid| Pid::from_raw(pid.cast_signed()));
        if let Some(pid) = pid
            && let Err(error) = kill_process_group(pid, signal)
        {
            // It may have ended in between.
            tracing::debug!("signal to {}: {error}", self.label);
        }
    }

    /// Whether it has ended. It is not started again from now on.
    pub fn has_ended(&mut self) -> bool {
        self.retry_at = None;
        match &mut self.child {
            None => true,
            Some(child) => matches!(child.try_wait(), Ok(Some(_)) | Err(_)),
        }
    }
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

fn wants_restart(policy: Restart, status: ExitStatus) -> bool {
    match policy {
        Restart::Never => false,
        Restart::OnFailure => !status.success(),
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

/// A process that lived this long did not fail at its start.
const LONG_LIFE: Duration = Duration::from_secs(10);

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
    use super::*;

    #[test]
    fn policies_decide_on_restarts() {
        let (fine, failed) = (ExitStatus::from_raw(0), ExitStatus::from_raw(1 << 8));
        let killed = ExitStatus::from_raw(9);
        for (policy, wanted) in [
            (Restart::Never, [false, false, false]),
            (Restart::OnFailure, [false, true, true]),
            (Restart::Always, [true, true, true]),
        ] {
            assert_eq!([fine, failed, killed].map(|status| wants_restart(policy, status)), wanted);
        }
        assert_eq!(describe(killed), "was killed by signal 9");
    }
}
