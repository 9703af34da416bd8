//! `flockeye exec-stage`: the first instructions of a stage's process.
//!
//! The stage must die with the launcher, even if that is killed. So this process first requests a
//! signal from the kernel at the launcher's death. Then it checks that the launcher still lives. A
//! stage that must fly on without it (`--keep`) first writes a record of itself for the next
//! launcher. Only then it withdraws that request: no process is ever lost. The process also sets
//! its processors, nice value and scheduling policy, which survive the exec. Then it executes the
//! stage's program, in any language.

use std::ffi::OsString;
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::Command;

use anyhow::{Context, bail};
use clap::Args;
use flockeye_config::Scheduling;
use flockeye_runtime::instance::{
    FOLDER_VARIABLE, GENERATION_VARIABLE, REPLICA_VARIABLE, STAGE_VARIABLE,
};
use flockeye_runtime::kept::KeptProcess;
use flockeye_runtime::scheduling;
use flockeye_runtime::stage::CANNOT_START;
use rustix::process::{Signal, getppid, set_parent_process_death_signal, setpriority_process};
use rustix::thread::{CpuSet, sched_setaffinity};

/// Arguments of `exec-stage`.
#[derive(Debug, Args)]
pub struct ExecArguments {
    /// The launcher: this process must not outlive it.
    #[arg(long)]
    pub parent: u32,
    /// Outlive it all the same, known to the next launcher by a record in the instance's folder.
    #[arg(long)]
    pub keep: bool,
    /// Processors that it may run on.
    #[arg(long, value_delimiter = ',')]
    pub cpus: Vec<u32>,
    /// Its nice value.
    #[arg(long, default_value_t = 0, allow_negative_numbers = true)]
    pub nice: i32,
    /// Its scheduling policy: batch, idle, fifo or round-robin.
    #[arg(long, value_parser = scheduling::from_name)]
    pub scheduling: Option<Scheduling>,
    /// Its priority within fifo and round-robin.
    #[arg(long, default_value_t = 1)]
    pub priority: u8,
    /// The stage's program and its arguments.
    #[arg(trailing_var_arg = true, allow_hyphen_values = true, required = true)]
    pub command: Vec<OsString>,
}

/// Becomes the stage.
///
/// # Errors
/// The launcher is dead, its record cannot be written, or the program cannot be started.
pub fn run(arguments: &ExecArguments) -> anyhow::Result<()> {
    set_parent_process_death_signal(Some(Signal::KILL))
        .context("cannot ask for a signal at the launcher's death")?;
    let parent = getppid().map(|pid| pid.as_raw_nonzero().get().unsigned_abs());
    if parent != Some(arguments.parent) {
        bail!("the launcher (process {}) has ended", arguments.parent);
    }
    if arguments.keep {
        write_record(arguments).context("cannot write the record of this process")?;
        set_parent_process_death_signal(None).context("cannot outlive the launcher")?;
    }
    // A stage works even if its scheduling is refused.
    let refusals = [apply_cpus(arguments), apply_nice(arguments), apply_policy(arguments)];
    for refusal in refusals.into_iter().flatten() {
        eprintln!("{refusal}");
    }
    let Some((program, rest)) = arguments.command.split_first() else {
        bail!("no program to start")
    };
    let error = Command::new(program).args(rest).exec();
    eprintln!("cannot start {}: {error}", program.to_string_lossy());
    // Another attempt would not find the program either.
    std::process::exit(i32::from(CANNOT_START))
}

/// Writes the record by which later launchers find this process.
fn write_record(arguments: &ExecArguments) -> anyhow::Result<()> {
    let variable = |name: &str| std::env::var(name).with_context(|| format!("{name} is not set"));
    let command = arguments.command.iter().map(|part| part.to_string_lossy().into_owned());
    let process = KeptProcess {
        stage: variable(STAGE_VARIABLE)?,
        replica: variable(REPLICA_VARIABLE)?.parse()?,
        generation: variable(GENERATION_VARIABLE)?.parse()?,
        pid: std::process::id(),
        command: command.collect(),
    };
    Ok(process.write(&PathBuf::from(variable(FOLDER_VARIABLE)?))?)
}

/// Sets the processors. Returns the reason of a refusal.
fn apply_cpus(arguments: &ExecArguments) -> Option<String> {
    if arguments.cpus.is_empty() {
        return None;
    }
    let mut set = CpuSet::new();
    for &cpu in arguments.cpus.iter().filter(|&&cpu| (cpu as usize) < CpuSet::MAX_CPU) {
        set.set(cpu as usize);
    }
    let refused = sched_setaffinity(None, &set).err()?;
    Some(format!(
        "processors {:?} are refused ({refused}): it runs on any. Cure: `cpus` with some of 0 to {}",
        arguments.cpus,
        std::thread::available_parallelism().map_or(0, |count| count.get() - 1)
    ))
}

/// Sets the nice value. Returns the reason of a refusal.
fn apply_nice(arguments: &ExecArguments) -> Option<String> {
    if arguments.nice == 0 {
        return None;
    }
    let refused = setpriority_process(None, arguments.nice).err()?;
    Some(format!(
        "nice {} is not allowed ({refused}): it keeps the inherited value. Cure: LimitNICE in the \
         unit, or CAP_SYS_NICE",
        arguments.nice
    ))
}

/// Sets the scheduling policy. Returns the reason of a refusal.
fn apply_policy(arguments: &ExecArguments) -> Option<String> {
    let policy = arguments.scheduling?;
    let refused = scheduling::apply_to_this_thread(policy, arguments.priority).err()?;
    let policy = scheduling::name(policy);
    Some(format!(
        "the scheduling policy {policy} is refused ({refused}): it runs with the normal one. Cure: \
         LimitRTPRIO in the unit, or CAP_SYS_NICE"
    ))
}
