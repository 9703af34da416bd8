//! Threads for background work, with a lower priority than all others.

use std::io;
use std::thread::{Builder, JoinHandle};

use flockeye_config::Scheduling;
use rustix::process::{getpriority_process, setpriority_process};

use crate::scheduling::{apply_to_this_thread, of_this_thread};

/// Added to the process's nice value. Under load such a thread gets a tenth of the processor time
/// of a thread with nice value 0.
const NICER: i32 = 10;
/// The largest nice value.
const NICEST: i32 = 19;

/// Starts a thread of lower priority: its nice value is raised, and it leaves the real-time class
/// if the process is in it. If the system refuses either, the thread runs without that change.
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

/// Brings the calling thread from real time to the normal policy.
fn leave_real_time() {
    if of_this_thread().is_some_and(Scheduling::is_real_time) {
        // Leaving real time needs no privilege. If it is refused, the thread still works.
        let _ = apply_to_this_thread(Scheduling::Normal, 0);
    }
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
            // Without the privilege this is refused, and there is nothing to leave.
            let _ = apply_to_this_thread(Scheduling::Fifo, 1);
            (of_this_thread(), spawn("background", of_this_thread).unwrap().join().unwrap())
        })
        .join()
        .unwrap();
        assert!(of_others.is_some());
        assert_eq!(background, Some(Scheduling::Normal), "others: {of_others:?}");
    }
}
