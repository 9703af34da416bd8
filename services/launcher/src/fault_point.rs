//! Fault points: steps of a hand-over at which a test stops the launcher and kills a process.
//!
//! They are built in with the feature `fault-points` alone, as `make test` does, and never in what
//! flies.

use std::path::Path;

/// Notice that a launcher with fault points shows at its start.
#[cfg(feature = "fault-points")]
pub(crate) const NOTICE: Option<&str> = Some("this build has fault points, for tests alone");
/// Notice that a launcher with fault points shows at its start.
#[cfg(not(feature = "fault-points"))]
pub(crate) const NOTICE: Option<&str> = None;

/// Waits here if the file `fault` in the instance's folder names this step. The file becomes
/// `fault-reached`; its removal ends the wait.
#[cfg(feature = "fault-points")]
pub(crate) fn pass(folder: &Path, step: &str) {
    use std::time::{Duration, Instant};
    let (wanted, reached) = (folder.join("fault"), folder.join("fault-reached"));
    let is_wanted = std::fs::read_to_string(&wanted).is_ok_and(|text| text.trim() == step);
    if !is_wanted || std::fs::rename(&wanted, &reached).is_err() {
        return;
    }
    let start = Instant::now();
    while reached.exists() && start.elapsed() < Duration::from_secs(30) {
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// Does nothing: this build has no fault points.
#[cfg(not(feature = "fault-points"))]
pub(crate) fn pass(_folder: &Path, _step: &str) {}
