//! What can go wrong with a recording.

use std::path::PathBuf;

/// Why a recording cannot be written or read.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    /// The file cannot be opened, written or read.
    #[error("{}: {error}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        error: std::io::Error,
    },
    /// The file holds something already.
    #[error(
        "{} is there already. Cure: name another file; `flockeye record` overwrites none", path.display()
    )]
    Exists {
        /// The file.
        path: PathBuf,
    },
    /// Another process writes it.
    #[error("{} is being written by another recorder. Cure: name another file", path.display())]
    Locked {
        /// The file.
        path: PathBuf,
    },
    /// The disk has no room for more.
    #[error(
        "{}: the disk has {free_mb} MB left, so the recording ends here, whole. Cure: make room, or record \
         elsewhere or less (--frames)", path.display()
    )]
    DiskFull {
        /// The file.
        path: PathBuf,
        /// What is free, 10^6 bytes.
        free_mb: u64,
    },
    /// Nothing is in it.
    #[error(
        "{} is empty: nothing was recorded. Cure: record again; the recorder says what it waits for",
        path.display()
    )]
    Empty {
        /// The file.
        path: PathBuf,
    },
    /// The file is no MCAP file.
    #[error(
        "{} is no MCAP file: it does not begin as one. Cure: give a file that `flockeye record` wrote",
        path.display()
    )]
    NotMcap {
        /// The file.
        path: PathBuf,
    },
    /// The file is an MCAP file of another program.
    #[error(
        "{} is an MCAP file, but no recording of Flockeye: {reason}. Cure: give a file that `flockeye \
         record` wrote", path.display()
    )]
    Foreign {
        /// The file.
        path: PathBuf,
        /// How that shows.
        reason: String,
    },
    /// A part of it is not as it was written.
    #[error(
        "{}: damaged near byte {offset}: {reason}. Cure: `flockeye record --recover {} GOOD.mcap` keeps what \
         lies before", path.display(), path.display()
    )]
    Damaged {
        /// The file.
        path: PathBuf,
        /// Where, bytes from the beginning.
        offset: u64,
        /// What is wrong there.
        reason: String,
    },
    /// A message does not fit what its channel says.
    #[error("a message of {channel} {reason}")]
    Message {
        /// The channel.
        channel: String,
        /// What is wrong.
        reason: String,
    },
    /// A message cannot be made.
    #[error(transparent)]
    Ros2(#[from] flockeye_ros2::Ros2Error),
    /// What the MCAP library says of its own use.
    #[error("the recording cannot be written: {0}")]
    Mcap(#[from] mcap::McapError),
}
