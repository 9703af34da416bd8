//! `flockeye exec-stage`: the first instructions of a stage's process.
//!
//! The stage dies with the launcher, even if the launcher is killed: the kernel is asked to see to
//! it, and because the launcher may have died just before, its life is checked after asking. Then
//! this process becomes the stage, whatever language it is written in.

use std::os::unix::process::CommandExt;
use std::process::Command;

use anyhow::{Context, bail};
use flockeye_runtime::stage::CANNOT_START;
use rustix::process::{Signal, getppid, set_parent_process_death_signal};

use crate::cli::ExecStage;

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
    let Some((program, rest)) = arguments.command.split_first() else {
        bail!("no program to start")
    };
    let error = Command::new(program).args(rest).exec();
    eprintln!("cannot start {}: {error}", program.to_string_lossy());
    // A program that is not there will not be there at the next attempt either.
    std::process::exit(i32::from(CANNOT_START))
}
