//! Errors of writing and reading recordings.

use std::path::PathBuf;

/// The reason why a recording cannot be written or read.
#[allow(missing_docs, reason = "the messages say what each is")]
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    #[error("{}: {error}", path.display())]
    File { path: PathBuf, error: std::io::Error },
    #[error(
        "{} is there already. Cure: name another file; `flockeye record` overwrites none", path.display()
    )]
    Exists { path: PathBuf },
    #[error("{} is being written by another recorder. Cure: name another file", path.display())]
    Locked { path: PathBuf },
    #[error(
        "{}: the disk has {free_mb} MB left, so the recording ends here, whole. Cure: make room, or record \
         elsewhere or less (--frames)", path.display()
    )]
    DiskFull { path: PathBuf, free_mb: u64 },
    #[error(
        "{} is empty: nothing was recorded. Cure: record again; the recorder says what it waits for",
        path.display()
    )]
    Empty { path: PathBuf },
    #[error(
        "{} is no MCAP file: it does not begin as one. Cure: give a file that `flockeye record` wrote",
        path.display()
    )]
    NotMcap { path: PathBuf },
    #[error(
        "{} is an MCAP file, but no recording of Flockeye: {reason}. Cure: give a file that `flockeye \
         record` wrote", path.display()
    )]
    Foreign { path: PathBuf, reason: String },
    #[error(
        "{}: damaged near byte {offset}: {reason}. Cure: `flockeye record --recover {} GOOD.mcap` keeps what \
         lies before", path.display(), path.display()
    )]
    Damaged { path: PathBuf, offset: u64, reason: String },
    #[error("a message of {channel} {reason}")]
    Message { channel: String, reason: String },
    #[error(transparent)]
    Ros2(#[from] flockeye_ros2::Ros2Error),
    #[error("the recording cannot be written: {0}")]
    Mcap(#[from] mcap::McapError),
}
