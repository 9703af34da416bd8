//! Discovery and control of running recorders. Each has a file named by its process's number in the
//! instance's folder, locked as long as it runs. The file contains the recording's path.

use std::ffi::OsString;
use std::fs::File;
use std::io::{self, Write};
use std::os::unix::ffi::{OsStrExt, OsStringExt};
use std::path::{Path, PathBuf};

use rustix::fs::{FlockOperation, flock};
use rustix::process::{Pid, Signal, kill_process};

use crate::instance::Instance;

/// This recorder's file, as long as it runs.
#[derive(Debug)]
pub struct Presence {
    path: PathBuf,
    _lock: File,
}

impl Presence {
    /// Announces that this process records to `out` and misses nothing from now on. `keeps_past`:
    /// it writes the past on request.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn announce(instance: &Instance, keeps_past: bool, out: &Path) -> io::Result<Self> {
        let path = path(instance, std::process::id(), keeps_past);
        let fresh = path.with_extension("new");
        path.parent().map_or(Ok(()), std::fs::create_dir_all)?;
        let mut lock = File::create(&fresh)?;
        lock.write_all(std::path::absolute(out)?.as_os_str().as_bytes())?;
        flock(&lock, FlockOperation::NonBlockingLockExclusive)?;
        // The file appears only after it is locked.
        std::fs::rename(&fresh, &path)?;
        Ok(Self { path, _lock: lock })
    }
}

impl Drop for Presence {
    fn drop(&mut self) {
        // The launcher may have removed the folder already.
        std::fs::remove_file(&self.path).ok();
    }
}

fn folder(instance: &Instance) -> PathBuf {
    instance.folder().join("recorders")
}

fn path(instance: &Instance, process: u32, keeps_past: bool) -> PathBuf {
    let kind = if keeps_past { "past" } else { "all" };
    folder(instance).join(format!("{process}.{kind}"))
}

/// Whether the recorder of this process runs and misses nothing.
pub fn has_joined(instance: &Instance, process: u32) -> bool {
    [false, true].into_iter().any(|keeps_past| is_locked(&path(instance, process, keeps_past)))
}

/// The recorders of an instance that run.
pub fn running(instance: &Instance) -> Vec<Pid> {
    living(instance).filter_map(|path| process(&path)).collect()
}

/// Recording of a running recorder that writes continuously; of several, the first one.
pub fn recording(instance: &Instance) -> Option<PathBuf> {
    let whole = living(instance).filter(|path| path.extension() == Some("all".as_ref()));
    let begun = whole
        .filter_map(|path| Some((path.metadata().and_then(|about| about.modified()).ok()?, path)));
    let (_, first) = begun.min()?;
    Some(PathBuf::from(OsString::from_vec(std::fs::read(first).ok()?)))
}

/// Requests the recorders of an instance that keep the past to write it. Returns their number.
pub fn ask_to_write(instance: &Instance) -> usize {
    let keeping = living(instance).filter(|path| path.extension() == Some("past".as_ref()));
    let processes = keeping.filter_map(|path| process(&path));
    // A recorder that has ended meanwhile has nothing to write.
    processes.filter(|process| kill_process(*process, Signal::USR1).is_ok()).count()
}

fn process(path: &Path) -> Option<Pid> {
    path.file_stem()?.to_str()?.parse().ok().and_then(Pid::from_raw)
}

fn living(instance: &Instance) -> impl Iterator<Item = PathBuf> + use<> {
    let entries = std::fs::read_dir(folder(instance)).into_iter().flatten().flatten();
    entries.map(|entry| entry.path()).filter(|path| is_locked(path))
}

fn is_locked(path: &Path) -> bool {
    File::open(path).is_ok_and(|file| flock(&file, FlockOperation::NonBlockingLockShared).is_err())
}
