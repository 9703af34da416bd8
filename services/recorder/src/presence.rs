//! How a running recorder is found and asked: a locked file with its process's number in the instance's folder.

use std::fs::{File, OpenOptions};
use std::path::PathBuf;

use anyhow::{Context, ensure};
use flockeye_runtime::instance::Instance;
use rustix::fs::{FlockOperation, flock};
use rustix::process::{Pid, Signal, kill_process};

/// The folder of all recorders of an instance.
const FOLDER: &str = "recorders";

/// This recorder's file, as long as it runs.
#[derive(Debug)]
pub struct Presence {
    path: PathBuf,
    _lock: File,
}

impl Presence {
    /// Says that this process records: from now on it misses nothing.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn announce(instance: &Instance) -> anyhow::Result<Self> {
        let folder = instance.folder().join(FOLDER);
        std::fs::create_dir_all(&folder).with_context(|| folder.display().to_string())?;
        let path = folder.join(std::process::id().to_string());
        let lock = File::create(&path).with_context(|| path.display().to_string())?;
        flock(&lock, FlockOperation::NonBlockingLockExclusive)
            .with_context(|| path.display().to_string())?;
        Ok(Self { path, _lock: lock })
    }
}

impl Drop for Presence {
    fn drop(&mut self) {
        // The launcher may have removed the folder already.
        std::fs::remove_file(&self.path).ok();
    }
}

/// The recorders of an instance that run.
fn recorders(instance: &Instance) -> Vec<Pid> {
    let entries = std::fs::read_dir(instance.folder().join(FOLDER)).into_iter().flatten().flatten();
    let living = entries.filter(|entry| {
        let file = OpenOptions::new().read(true).open(entry.path());
        // Only a recorder that runs holds the lock for longer than this check.
        file.is_ok_and(|file| flock(&file, FlockOperation::NonBlockingLockShared).is_err())
    });
    living
        .filter_map(|entry| {
            entry.file_name().to_string_lossy().parse().ok().and_then(Pid::from_raw)
        })
        .collect()
}

/// Asks all recorders of an instance to write what they keep. Returns how many there are.
///
/// # Errors
/// None runs.
pub fn ask_to_write(instance: &Instance) -> anyhow::Result<usize> {
    let recorders = recorders(instance);
    ensure!(
        !recorders.is_empty(),
        "nobody records the pipeline '{}'. Cure: `flockeye record OUT.mcap --trigger request`",
        instance.name()
    );
    for recorder in &recorders {
        // One that has ended meanwhile has nothing to write.
        kill_process(*recorder, Signal::USR1).ok();
    }
    Ok(recorders.len())
}
