//! Runs `flockeye up` as a process of its own.

use std::collections::VecDeque;
use std::ffi::OsString;
use std::io::{self, BufRead, BufReader, Read};
use std::os::unix::process::CommandExt;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use anyhow::{Context, anyhow, bail};
use flockeye_cli::program;
use rustix::process::{Pid, Signal, kill_process, set_parent_process_death_signal};

/// Number of lines of each output stream that are kept for error messages.
const KEPT_LINES: usize = 40;
/// Prefix of an error message of `flockeye`.
const ERROR_PREFIX: &str = "flockeye: ";

/// Runs `flockeye up` with these arguments to its end. Its output goes to this terminal.
///
/// # Errors
/// The program cannot be started, or it fails. Its own message is then on the terminal.
pub(crate) fn run_visibly(arguments: &[OsString], stopping: &AtomicBool) -> anyhow::Result<()> {
    let mut child = start(arguments, Stdio::inherit, Stdio::inherit)?;
    let status = wait(&mut child, stopping)?;
    if status.success() {
        return Ok(());
    }
    bail!("`flockeye up` failed ({status}); its reason is above")
}

/// Runs `flockeye up` with these arguments to its end, and returns the last lines of its log.
///
/// # Errors
/// The program cannot be started, or it fails. The error contains its log, `what` and its reason.
pub(crate) fn run_quietly(
    what: &str,
    arguments: &[OsString],
    stopping: &AtomicBool,
) -> anyhow::Result<String> {
    let mut child = start(arguments, Stdio::piped, Stdio::piped)?;
    let output = child.stdout.take().map(keep_lines);
    let errors = child.stderr.take().map(keep_lines);
    let status = wait(&mut child, stopping)?;
    let lines = |thread: Option<JoinHandle<Vec<String>>>| {
        thread.and_then(|thread| thread.join().ok()).unwrap_or_default()
    };
    let (mut log, errors) = (lines(output), lines(errors));
    let first = errors.iter().rposition(|line| line.starts_with(ERROR_PREFIX));
    let (before, reason) = errors.split_at(first.unwrap_or(errors.len()));
    log.extend_from_slice(before);
    let log: String = log.into_iter().map(|line| line + "\n").collect();
    if status.success() {
        return Ok(log);
    }
    let reason = reason.join("\n");
    let reason = match reason.strip_prefix(ERROR_PREFIX) {
        Some(reason) => anyhow!("{reason}"),
        None => anyhow!("`flockeye up` failed ({status})"),
    };
    Err(reason.context(format!("{log}{what}")))
}

fn start(
    arguments: &[OsString],
    stdout: fn() -> Stdio,
    stderr: fn() -> Stdio,
) -> anyhow::Result<Child> {
    let mut command = Command::new(program::find("flockeye")?);
    command.arg("up").args(arguments);
    command.stdin(Stdio::null()).stdout(stdout()).stderr(stderr());
    let end_with_parent =
        || set_parent_process_death_signal(Some(Signal::TERM)).map_err(io::Error::from);
    // SAFETY: between fork and exec this makes one system call, and neither allocates nor locks.
    unsafe { command.pre_exec(end_with_parent) };
    command.spawn().context("cannot start `flockeye up`")
}

/// Waits for the end of the process. Sends SIGINT once `stopping` is set.
fn wait(child: &mut Child, stopping: &AtomicBool) -> anyhow::Result<ExitStatus> {
    let mut is_asked = false;
    loop {
        if let Some(status) = child.try_wait().context("cannot wait for `flockeye up`")? {
            return Ok(status);
        }
        if stopping.load(Ordering::Relaxed) && !is_asked {
            is_asked = true;
            // An error is ignored: the process may have ended, for example by Ctrl-C on the
            // terminal.
            let _ = kill_process(Pid::from_child(child), Signal::INT);
        }
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// Reads a stream to its end, and keeps its last lines.
fn keep_lines(stream: impl Read + Send + 'static) -> JoinHandle<Vec<String>> {
    std::thread::spawn(move || {
        let mut kept = VecDeque::new();
        for line in BufReader::new(stream).split(b'\n').map_while(Result::ok) {
            if kept.len() == KEPT_LINES {
                kept.pop_front();
            }
            kept.push_back(String::from_utf8_lossy(&line).into_owned());
        }
        kept.into()
    })
}
