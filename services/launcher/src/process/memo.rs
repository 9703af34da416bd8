//! Memo of each worker for a later launcher, with the facts that it cannot read elsewhere (`up
//! --keep`).

use std::io;
use std::path::{Path, PathBuf};

use flockeye_runtime::kept;
use flockeye_runtime::whole_file::write_whole;
use serde::{Deserialize, Serialize};

use crate::control::WorkerName;

/// The memo of one worker, in a file of the instance's folder.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Memo {
    /// The highest generation of any of its processes.
    pub used_generations: u32,
    /// The generation of the process that counts unless a hand-over states otherwise.
    pub counting_generation: u32,
    /// The program of the next start.
    pub command: Vec<String>,
    /// Whether the process was ended on request.
    pub is_stopped: bool,
}

fn file(folder: &Path, worker: WorkerName) -> PathBuf {
    kept::folder(folder).join(format!("{worker}.memo"))
}

impl Memo {
    /// Writes the memo. A launcher that is killed meanwhile leaves the earlier memo.
    ///
    /// # Errors
    /// The file cannot be written.
    pub(crate) fn write(&self, folder: &Path, worker: WorkerName) -> io::Result<()> {
        let file = file(folder, worker);
        std::fs::create_dir_all(kept::folder(folder))?;
        write_whole(&file, &serde_json::to_vec(self)?)
    }

    /// The memo of a worker.
    pub(crate) fn read(folder: &Path, worker: WorkerName) -> Option<Self> {
        serde_json::from_slice(&std::fs::read(file(folder, worker)).ok()?).ok()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn memos_are_read_as_they_were_written() {
        let folder = std::env::temp_dir().join(format!("flock-memo-{}", std::process::id()));
        let worker: WorkerName = "detection.1".parse().unwrap();
        let memo = Memo {
            used_generations: 7,
            counting_generation: 5,
            command: vec!["python3".to_owned(), "detector.py".to_owned()],
            is_stopped: true,
        };
        assert_eq!(Memo::read(&folder, worker), None);
        memo.write(&folder, worker).unwrap();
        assert_eq!(Memo::read(&folder, worker), Some(memo));
        assert_eq!(Memo::read(&folder, "detection".parse().unwrap()), None);
        std::fs::remove_dir_all(folder).unwrap();
    }
}
