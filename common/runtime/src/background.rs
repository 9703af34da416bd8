//! Threads for work in the background, which gives way to all else.

use std::io;
use std::process::{Command, Stdio};
use std::thread::{Builder, JoinHandle};

use rustix::process::{getpriority_process, setpriority_process};
use rustix::thread::gettid;

/// Added to the process's nice value: under load such a thread gets a tenth of the processor time of a
/// thread with nice value 0.
const NICER: i32 = 10;
/// The largest nice value.
const NICEST: i32 = 19;

/// Starts a thread that gives way to other threads and processes: its nice value is raised, and it
/// leaves the real-time class if the process is in one. If the system refuses either, the thread runs
/// as it is.
///
/// # Errors
/// The system starts no thread.
pub fn spawn<T: Send + 'static>(
    name: &str,
    work: impl FnOnce() -> T + Send + 'static,
) -> io::Result<JoinHandle<T>> {
    Builder::new().name(name.to_owned()).spawn(move || {
        leave_real_time();
        let usual = getpriority_process(None).unwrap_or(0);
        // On Linux this applies to the calling thread only.
        let _ = setpriority_process(None, (usual.max(0) + NICER).min(NICEST));
        work()
    })
}

/// Brings the calling thread into the normal scheduling class, by util-linux's `chrt`, as the launcher
/// brings processes out of it.
fn leave_real_time() {
    const REAL_TIME: [u32; 2] = [1, 2];
    if class().is_some_and(|class| REAL_TIME.contains(&class)) {
        let thread = gettid().as_raw_nonzero().to_string();
        let mut chrt = Command::new("chrt");
        chrt.args(["--other", "--pid", "0", &thread]);
        let _ = chrt.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).status();
    }
}

/// The calling thread's scheduling class: field 41 of its stat file (proc(5)).
fn class() -> Option<u32> {
    let text = std::fs::read_to_string("/proc/thread-self/stat").ok()?;
    // The name, in parentheses, may hold blanks.
    let (_, from_third) = text.rsplit_once(") ")?;
    from_third.split_whitespace().nth(41 - 3)?.parse().ok()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    #[test]
    fn a_thread_gives_way_and_the_others_do_not() {
        let usual = getpriority_process(None).unwrap();
        let nice = || getpriority_process(None).unwrap();
        let background = spawn("background", nice).unwrap().join().unwrap();
        assert_eq!(background, (usual.max(0) + NICER).min(NICEST));
        assert_eq!(std::thread::spawn(nice).join().unwrap(), usual);
    }

    #[test]
    fn it_leaves_the_real_time_class() {
        let (of_others, background) = std::thread::spawn(|| {
            let thread = gettid().as_raw_nonzero().to_string();
            // Without the privilege the process is in no real-time class.
            let _ = Command::new("chrt").args(["--fifo", "--pid", "1", &thread]).output();
            (class(), spawn("background", class).unwrap().join().unwrap())
        })
        .join()
        .unwrap();
        assert!(of_others.is_some());
        assert_eq!(background, Some(0), "others: {of_others:?}");
    }
}
