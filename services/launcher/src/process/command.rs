//! Command line and environment of a worker's process.

use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use anyhow::Context;
use flockeye_config::{Scheduling, StageProcess, usual_nice};
use flockeye_contract::StageName;
use flockeye_runtime::backoff::Backoff;
use flockeye_runtime::instance::{
    FOLDER_VARIABLE, GENERATION_VARIABLE, REPLICA_VARIABLE, STAGE_VARIABLE,
};
use flockeye_runtime::scheduling;

use crate::control::WorkerName;

/// Common parameters of all processes of one worker.
#[derive(Debug, Clone)]
pub(super) struct StartPlan {
    /// Program and arguments.
    pub program: Vec<String>,
    pub folder: PathBuf,
    /// Whether the processes fly on when the launcher dies.
    pub is_kept: bool,
    /// Scheduling and processors, as arguments of `exec-stage`.
    scheduling: Vec<String>,
}

impl StartPlan {
    pub(crate) fn of(
        stage: StageName,
        configuration: &StageProcess,
        folder: &Path,
        is_kept: bool,
    ) -> anyhow::Result<Self> {
        Ok(Self {
            program: program(stage.name(), configuration)?,
            folder: folder.to_owned(),
            is_kept,
            scheduling: scheduling_arguments(stage, configuration),
        })
    }

    /// Command of a process of this generation. The caller sets the destination of its output.
    pub(crate) fn command(&self, worker: WorkerName, generation: u32) -> Command {
        // This program, and not the file at its path: an update may have replaced that.
        let mut command = Command::new("/proc/self/exe");
        if std::env::var_os("XDG_RUNTIME_DIR").is_none() {
            // Graphics drivers warn without this variable.
            command.env("XDG_RUNTIME_DIR", &self.folder);
        }
        command
            .args(["exec-stage", "--parent", &std::process::id().to_string()])
            .args(self.is_kept.then_some("--keep"))
            .args(&self.scheduling)
            .arg("--")
            .args(&self.program)
            .env(FOLDER_VARIABLE, &self.folder)
            .env(STAGE_VARIABLE, worker.stage.name())
            .env(REPLICA_VARIABLE, worker.replica.to_string())
            .env(GENERATION_VARIABLE, generation.to_string())
            .stdin(Stdio::null())
            .process_group(0);
        command
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

/// The waits between attempts.
pub(super) fn backoff([first_s, longest_s]: [f64; 2]) -> Backoff {
    let wait = |s: f64| Duration::try_from_secs_f64(s).unwrap_or(Duration::from_secs(1));
    Backoff::new(wait(first_s), wait(longest_s))
}

/// Arguments of `exec-stage` for scheduling and processors of a stage.
fn scheduling_arguments(stage: StageName, configuration: &StageProcess) -> Vec<String> {
    let nice = configuration.nice.unwrap_or(usual_nice(stage));
    let mut arguments = vec![format!("--nice={nice}")];
    if !configuration.cpus.is_empty() {
        let cpus: Vec<String> = configuration.cpus.iter().map(u32::to_string).collect();
        arguments.push(format!("--cpus={}", cpus.join(",")));
    }
    if configuration.scheduling == Scheduling::Normal {
        return arguments;
    }
    arguments.push(format!("--scheduling={}", scheduling::name(configuration.scheduling)));
    arguments.push(format!("--priority={}", configuration.priority));
    arguments
}
