//! `flockeye status`, `stop`, `start`, `restart` and `swap`: requests to a running pipeline.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant, SystemTime};

use anyhow::{Context, ensure};
use clap::Args;
use flockeye_cli::running::{PipelineChoice, choose};
use flockeye_cli::{Screen, duration, signals};
use flockeye_runtime::instance::Instance;
use rustix::process::Signal;

use crate::control::client::ask;
use crate::control::{ControlRequest, SwapRequest, WorkerName};
use crate::process::{KILL_TIME, STOP_TIME, signal_group};

/// Arguments of `swap`.
#[derive(Debug, Args)]
pub(crate) struct SwapArguments {
    /// The stage, or one worker of it: detection.1.
    #[arg(value_name = "STAGE[.REPLICA]")]
    pub worker: WorkerName,
    #[command(flatten)]
    pub running: PipelineChoice,
    /// Change a setting that this stage reads. All its later processes have it too.
    #[arg(long = "set", value_name = "KEY.PATH=VALUE")]
    pub set: Vec<String>,
    /// How long the new process may take until it does as well as the old one.
    #[arg(long, value_name = "DURATION", value_parser = duration, default_value = "10s")]
    pub within: Duration,
    /// Take over even if it answers or finds less than the old one.
    #[arg(long)]
    pub accept_worse: bool,
    /// Swap again each time this file changes, until Ctrl-C.
    #[arg(long, value_name = "FILE")]
    pub watch: Option<PathBuf>,
    /// JSON: the comparison of both processes.
    #[arg(long)]
    pub json: bool,
    /// Another implementation, program and arguments. Without it: the one that runs, started anew.
    #[arg(last = true, value_name = "COMMAND")]
    pub program: Vec<String>,
}

/// Ends a worker, or the whole pipeline, even if its stages fly on without a launcher.
pub(crate) fn stop(worker: Option<WorkerName>, running: &PipelineChoice) -> anyhow::Result<()> {
    let instance = choose(running)?;
    if worker.is_none() && !instance.has_launcher() {
        return end_without_launcher(&instance);
    }
    ask_and_show(running, &ControlRequest::Stop { worker }, false)
}

/// Replaces a worker's process by another one in flight.
pub(crate) fn swap(arguments: &SwapArguments) -> anyhow::Result<()> {
    let request = ControlRequest::Swap(SwapRequest {
        worker: arguments.worker,
        set: arguments.set.clone(),
        program: arguments.program.iter().map(|part| absolute(part)).collect(),
        within_s: arguments.within.as_secs_f64(),
        accept_worse: arguments.accept_worse,
    });
    let Some(file) = &arguments.watch else {
        return ask_and_show(&arguments.running, &request, arguments.json);
    };
    let stopping = signals::stop_flag()?;
    let mut screen = Screen::new();
    let mut swapped = changed(file).with_context(|| format!("{}", file.display()))?;
    while !stopping.load(Ordering::Relaxed) {
        // The failure was shown; the next change of the file may correct it.
        if let Err(error) = ask_and_show(&arguments.running, &request, arguments.json) {
            screen.line(&format!("{error:#}"));
        }
        screen.line(&format!("waiting for {} to change", file.display()));
        swapped = wait_for_change(file, swapped, &stopping);
    }
    Ok(())
}

/// Ends stages that fly on without a launcher, and removes their leftovers.
fn end_without_launcher(instance: &Instance) -> anyhow::Result<()> {
    // From now on no launcher takes the stages over.
    let (ownership, kept) = instance.take_over()?;
    let living = || kept.iter().filter(|process| process.is_alive(instance.folder()));
    let count = living().count();
    for (signal, time) in [(Signal::TERM, STOP_TIME), (Signal::KILL, KILL_TIME)] {
        for process in living() {
            signal_group(process.pid, signal, &process.stage);
        }
        let start = Instant::now();
        while living().next().is_some() && start.elapsed() < time {
            std::thread::sleep(Duration::from_millis(5));
        }
    }
    ensure!(living().next().is_none(), "some stages do not end, although they were killed");
    drop(ownership);
    Screen::new().line(&format!("{count} stages without a launcher have ended"));
    Ok(())
}

/// Sends a request to the launcher of a running pipeline, and shows its progress and its reply.
pub(crate) fn ask_and_show(
    running: &PipelineChoice,
    request: &ControlRequest,
    json: bool,
) -> anyhow::Result<()> {
    let instance = choose(running)?;
    let mut screen = Screen::new();
    let (text, report) = ask(&instance, request, |progress| {
        if !json {
            screen.line(progress);
        }
    })?;
    screen.line(&if json { report.to_string() } else { text });
    Ok(())
}

/// Argument in the form that the launcher needs. The launcher runs in another folder, so a file is
/// named by its absolute path.
fn absolute(part: &str) -> String {
    let path = Path::new(part);
    match path.components().count() > 1 && path.exists() {
        true => std::path::absolute(path)
            .map_or_else(|_| part.to_owned(), |path| path.to_string_lossy().into_owned()),
        false => part.to_owned(),
    }
}

fn changed(file: &Path) -> std::io::Result<SystemTime> {
    std::fs::metadata(file)?.modified()
}

/// Waits until the file's time differs from `before` and stays unchanged for a moment: compilers
/// write for a while.
fn wait_for_change(file: &Path, before: SystemTime, stopping: &AtomicBool) -> SystemTime {
    let mut last = before;
    while !stopping.load(Ordering::Relaxed) {
        std::thread::sleep(Duration::from_millis(300));
        // While a compiler writes the file, it may be missing.
        let Ok(now) = changed(file) else { continue };
        if now != before && now == last {
            return now;
        }
        last = now;
    }
    before
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_named_by_their_whole_path_and_words_stay() {
        assert_eq!(absolute("python3"), "python3");
        assert_eq!(absolute("--threads"), "--threads");
        assert_eq!(absolute("/nowhere/detector"), "/nowhere/detector");
        let here = absolute("src/lib.rs");
        assert!(here.starts_with('/') && here.ends_with("src/lib.rs"), "{here}");
    }
}
