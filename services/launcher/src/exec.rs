//! `flockeye exec-stage`: the first instructions of a stage's process.
//!
//! The stage dies with the launcher, even if the launcher is killed: the kernel is asked to see to
//! it, and because the launcher may have died just before, its life is checked after asking. Then
//! this process becomes the stage, whatever language it is written in. What it is told of processors
//! and priority it asks for before that: they go on in whatever it becomes.

use std::os::unix::process::CommandExt;
use std::process::Command;

use anyhow::{Context, bail};
use flockeye_runtime::stage::CANNOT_START;
use rustix::process::{Signal, getppid, set_parent_process_death_signal, setpriority_process};
use rustix::thread::{CpuSet, sched_setaffinity};

use crate::cli::{ExecStage, SchedulingArgument};

/// Becomes the stage.
///
/// # Errors
/// The launcher is dead, or the program cannot be started.
pub fn run(arguments: &ExecStage) -> anyhow::Result<()> {
    set_parent_process_death_signal(Some(Signal::KILL)).context("cannot follow the launcher")?;
    let parent = getppid().map(|pid| pid.as_raw_nonzero().get().unsigned_abs());
    if parent != Some(arguments.parent) {
        bail!("the launcher (process {}) is gone", arguments.parent);
    }
    // A stage that does not get its turn as wished still works.
    for refusal in [place(arguments), yielding(arguments), class(arguments)].into_iter().flatten() {
        eprintln!("{refusal}");
    }
    let Some((program, rest)) = arguments.command.split_first() else {
        bail!("no program to start")
    };
    let error = Command::new(program).args(rest).exec();
    eprintln!("cannot start {}: {error}", program.to_string_lossy());
    // A program that is not there will not be there at the next attempt either.
    std::process::exit(i32::from(CANNOT_START))
}

/// Asks for the processors; says why it does not get them.
fn place(arguments: &ExecStage) -> Option<String> {
    if arguments.cpus.is_empty() {
        return None;
    }
    let mut set = CpuSet::new();
    for &cpu in arguments.cpus.iter().filter(|&&cpu| (cpu as usize) < CpuSet::MAX_CPU) {
        set.set(cpu as usize);
    }
    let refused = sched_setaffinity(None, &set).err()?;
    Some(format!(
        "processors {:?} are not to be had ({refused}): it runs on any. Cure: `cpus` with some of 0 to {}",
        arguments.cpus,
        std::thread::available_parallelism().map_or(0, |count| count.get() - 1)
    ))
}

/// Asks to give way to others, or not to.
fn yielding(arguments: &ExecStage) -> Option<String> {
    if arguments.nice == 0 {
        return None;
    }
    let refused = setpriority_process(None, arguments.nice).err()?;
    Some(format!(
        "nice {} is not allowed ({refused}): it runs with what it inherits. Cure: LimitNICE in the \
         unit, or CAP_SYS_NICE",
        arguments.nice
    ))
}

/// Asks for the scheduling class, by util-linux's `chrt`, which every Debian has.
fn class(arguments: &ExecStage) -> Option<String> {
    let (option, priority) = match arguments.scheduling? {
        SchedulingArgument::Batch => ("--batch", 0),
        SchedulingArgument::Idle => ("--idle", 0),
        SchedulingArgument::Fifo => ("--fifo", arguments.priority),
        SchedulingArgument::RoundRobin => ("--rr", arguments.priority),
    };
    let own = std::process::id().to_string();
    let asked = Command::new("chrt").args([option, "--pid", &priority.to_string(), &own]).output();
    let refused = match asked {
        Ok(output) if output.status.success() => return None,
        Ok(output) => String::from_utf8_lossy(&output.stderr).trim().to_owned(),
        Err(error) => format!("chrt cannot be started: {error}"),
    };
    Some(format!(
        "the scheduling class {} is not to be had ({refused}): it runs in the normal one. Cure: \
         LimitRTPRIO in the unit, or CAP_SYS_NICE",
        option.trim_start_matches("--")
    ))
}
