//! Processes that fly on when their launcher dies (`flockeye up --keep`), and their records for a
//! new launcher.
//!
//! Each process writes a record of itself into the instance's folder before it becomes its stage.
//! It keeps a lock on the record for as long as it lives. The kernel frees the lock at its end, so
//! a reused process number causes no mistake. Processes that a stage starts itself inherit the lock
//! unless they close it.

use std::fs::File;
use std::io;
use std::os::fd::IntoRawFd;
use std::path::{Path, PathBuf};

use rustix::fs::{FlockOperation, flock};
use rustix::io::{FdFlags, fcntl_setfd};
use serde::{Deserialize, Serialize};

/// The record of a process.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct KeptProcess {
    /// The stage's name in pipeline.yaml.
    pub stage: String,
    /// Number of the worker, from 0.
    pub replica: u32,
    /// Number of replacements of the worker's process.
    pub generation: u32,
    /// Its process number.
    pub pid: u32,
    /// Its program and arguments.
    pub command: Vec<String>,
}

/// The folder of the records in an instance's folder.
pub fn folder(instance_folder: &Path) -> PathBuf {
    instance_folder.join("kept")
}

impl KeptProcess {
    /// The file of its record.
    pub fn record(&self, instance_folder: &Path) -> PathBuf {
        folder(instance_folder)
            .join(format!("{}.{}-{}.json", self.stage, self.replica, self.generation))
    }

    /// The file of its output. A pipe would end with the launcher that reads it.
    pub fn output(&self, instance_folder: &Path) -> PathBuf {
        self.record(instance_folder).with_extension("log")
    }

    /// Writes the record of this process. The record is valid until the process ends, even if it
    /// executes another program.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn write(&self, instance_folder: &Path) -> io::Result<()> {
        let path = self.record(instance_folder);
        let fresh = path.with_extension("new");
        let mut file = File::create(&fresh)?;
        serde_json::to_writer(&mut file, self)?;
        flock(&file, FlockOperation::NonBlockingLockExclusive)?;
        // The stage inherits the lock. No code of the stage has the descriptor, so it stays open
        // until the end.
        fcntl_setfd(&file, FdFlags::empty())?;
        std::fs::rename(&fresh, &path)?;
        let _inherited = file.into_raw_fd();
        Ok(())
    }

    /// Whether the process lives.
    pub fn is_alive(&self, instance_folder: &Path) -> bool {
        File::open(self.record(instance_folder))
            .is_ok_and(|file| flock(&file, FlockOperation::NonBlockingLockShared).is_err())
    }

    /// Removes its leftovers after its end.
    pub fn forget(&self, instance_folder: &Path) {
        for path in [self.record(instance_folder), self.output(instance_folder)] {
            if let Err(error) = std::fs::remove_file(&path)
                && error.kind() != io::ErrorKind::NotFound
            {
                tracing::debug!("{}: {error}", path.display());
            }
        }
    }
}

/// All recorded processes, dead or alive, oldest generation first.
pub fn all(instance_folder: &Path) -> Vec<KeptProcess> {
    let entries = std::fs::read_dir(folder(instance_folder)).into_iter().flatten().flatten();
    let records =
        entries.map(|entry| entry.path()).filter(|path| path.extension() == Some("json".as_ref()));
    let mut found: Vec<KeptProcess> = records
        .filter_map(|path| serde_json::from_slice(&std::fs::read(path).ok()?).ok())
        .collect();
    found.sort_by_key(|process| process.generation);
    found
}

/// The processes that live.
pub fn living(instance_folder: &Path) -> Vec<KeptProcess> {
    let mut found = all(instance_folder);
    found.retain(|process| process.is_alive(instance_folder));
    found
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use std::process::{Command, Stdio};

    #[test]
    fn a_record_tells_whether_its_process_lives_whatever_it_has_become() {
        let scratch = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder(scratch.path())).unwrap();
        let process = KeptProcess {
            stage: "detection".to_owned(),
            replica: 1,
            generation: 3,
            pid: 4,
            command: vec!["python3".to_owned()],
        };
        // This process writes the record; `cat` inherits the lock, as a stage does by exec.
        process.write(scratch.path()).unwrap();
        let mut heir = Command::new("cat").stdin(Stdio::piped()).spawn().unwrap();
        assert_eq!(living(scratch.path()), std::slice::from_ref(&process));
        heir.kill().unwrap();
        heir.wait().unwrap();
        assert_eq!(all(scratch.path()), std::slice::from_ref(&process));
        process.forget(scratch.path());
        assert!(all(scratch.path()).is_empty());
    }
}
