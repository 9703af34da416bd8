//! Saved states of workers: a file in the instance's folder with the newest state for a successor.
//!
//! A process that is killed cannot hand anything over, so it saves its state while it works. Each
//! process has a file of its own, because two of a worker may run side by side. The file has two
//! places that are written in turn. A process that is killed while it writes one leaves the other
//! whole.

use std::collections::BTreeMap;
use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use crate::health::Identity;
use crate::instance::Instance;

/// Maximum number of files of one worker. At most two of its processes run at once; the other files
/// are of dead ones.
const MOST_FILES: usize = 8;

/// Bytes of a place; the file is sparse.
const PLACE_BYTES: u64 = 1 << 22;

/// Bytes before a state: the time of saving, and its length. The time is repeated after it.
const HEAD_BYTES: usize = 16;
const TAIL_BYTES: usize = 8;

/// States of one worker's processes.
#[derive(Debug, Clone)]
pub struct SavedStates {
    folder: PathBuf,
    identity: Identity,
}

/// The newest state that another process of a worker saved.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SavedState {
    /// The state.
    pub state: Vec<u8>,
    /// Age by CLOCK_MONOTONIC.
    pub age: Duration,
    /// Generation of the process that saved it.
    pub generation: u32,
}

impl SavedStates {
    /// The states of this process's worker.
    pub fn of(instance: &Instance, identity: &Identity) -> Self {
        Self { folder: instance.folder().join("state"), identity: identity.clone() }
    }

    /// Folder of all states, also for other files that a process leaves to its successor.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// The newest state of the worker's other processes, with its age at `now_ns`.
    ///
    /// # Errors
    /// The folder or a file in it cannot be read.
    pub fn newest(&self, now_ns: i64) -> io::Result<Option<SavedState>> {
        let mut newest: Option<SavedState> = None;
        for (generation, path) in self.files()? {
            if generation == self.identity.generation {
                continue;
            }
            let Some((saved_ns, state)) = saved_in(&path)? else { continue };
            let Ok(age_ns) = u64::try_from(now_ns - saved_ns) else { continue };
            let saved = SavedState { state, age: Duration::from_nanos(age_ns), generation };
            if newest.as_ref().is_none_or(|newest| saved.age < newest.age) {
                newest = Some(saved);
            }
        }
        Ok(newest)
    }

    /// The worker's files, by the generations of their processes.
    fn files(&self) -> io::Result<BTreeMap<u32, PathBuf>> {
        let entries = match std::fs::read_dir(&self.folder) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(BTreeMap::new()),
            entries => entries?,
        };
        let paths: Result<Vec<PathBuf>, _> =
            entries.map(|entry| entry.map(|entry| entry.path())).collect();
        Ok(paths?.into_iter().filter_map(|path| Some((self.generation_of(&path)?, path))).collect())
    }

    /// The keeper of this process's states. The oldest files are removed where there are too many.
    ///
    /// # Errors
    /// The file cannot be made.
    pub fn keeper(&self) -> io::Result<StateKeeper> {
        std::fs::create_dir_all(&self.folder)?;
        // A running process has saved recently, whatever its generation.
        let mut files: Vec<_> = self
            .files()?
            .into_values()
            .map(|path| Ok((saved_in(&path)?.map(|(saved_ns, _)| saved_ns), path)))
            .collect::<io::Result<_>>()?;
        files.sort();
        let most = files.len().saturating_sub(MOST_FILES - 1);
        for (_, oldest) in files.drain(..most) {
            // Another process may have removed the file already.
            drop(std::fs::remove_file(oldest));
        }
        let name = format!("{}{}", self.name(), self.identity.generation);
        let file = File::create(self.folder.join(name))?;
        Ok(StateKeeper { file, place: 0, bytes: Vec::new() })
    }

    fn name(&self) -> String {
        format!("{}.{}.", self.identity.stage, self.identity.replica)
    }

    fn generation_of(&self, path: &Path) -> Option<u32> {
        path.file_name()?.to_str()?.strip_prefix(&self.name())?.parse().ok()
    }
}

/// Saves the states of one process.
#[derive(Debug)]
pub struct StateKeeper {
    file: File,
    /// The place of the next write.
    place: u64,
    bytes: Vec<u8>,
}

impl StateKeeper {
    /// Saves a state with the time `now_ns` of CLOCK_MONOTONIC.
    ///
    /// # Errors
    /// A state of more than 4 MiB, or a file that cannot be written.
    pub fn save(&mut self, now_ns: i64, state: &[u8]) -> io::Result<()> {
        self.bytes.clear();
        self.bytes.extend_from_slice(&now_ns.to_le_bytes());
        self.bytes.extend_from_slice(&(state.len() as u64).to_le_bytes());
        self.bytes.extend_from_slice(state);
        self.bytes.extend_from_slice(&now_ns.to_le_bytes());
        if self.bytes.len() as u64 > PLACE_BYTES {
            return Err(io::Error::new(
                io::ErrorKind::FileTooLarge,
                format!("a state of {} bytes; there is room for {PLACE_BYTES}", state.len()),
            ));
        }
        self.file.write_all_at(&self.bytes, self.place * PLACE_BYTES)?;
        self.place = 1 - self.place;
        Ok(())
    }
}

/// The newer complete state in a file, and the time of saving, nanoseconds.
fn saved_in(path: &Path) -> io::Result<Option<(i64, Vec<u8>)>> {
    let file = match File::open(path) {
        // Another process of the worker may have removed it.
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        file => file?,
    };
    let places = [0, PLACE_BYTES].map(|at| whole_state(&file, at));
    Ok(places.into_iter().flatten().max_by_key(|(saved_ns, _)| *saved_ns))
}

/// The state at a place, if it was written completely.
fn whole_state(file: &File, at: u64) -> Option<(i64, Vec<u8>)> {
    let mut head = [0; HEAD_BYTES];
    file.read_exact_at(&mut head, at).ok()?;
    let (saved_ns, length) = head.split_first_chunk::<8>()?;
    let length = u64::from_le_bytes(*length.first_chunk()?);
    if length > PLACE_BYTES {
        return None;
    }
    let mut state = vec![0; length as usize + TAIL_BYTES];
    file.read_exact_at(&mut state, at + HEAD_BYTES as u64).ok()?;
    let is_whole = state.split_off(length as usize) == saved_ns;
    is_whole.then_some((i64::from_le_bytes(*saved_ns), state))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    fn states(folder: &Path, replica: u32, generation: u32) -> SavedStates {
        let identity = Identity { stage: "fusion".to_owned(), replica, generation };
        SavedStates { folder: folder.join("state"), identity }
    }

    #[test]
    fn a_successor_gets_the_newest_state_of_its_own_worker() {
        let folder = tempfile::tempdir().unwrap();
        let of = |replica, generation| states(folder.path(), replica, generation);
        assert_eq!(of(0, 0).newest(0).unwrap(), None, "nobody has saved anything");
        let mut keepers = [of(0, 0), of(0, 1), of(1, 0)].map(|states| states.keeper().unwrap());
        assert_eq!(of(0, 2).newest(0).unwrap(), None, "nor has anybody now");
        for (k, keeper) in keepers.iter_mut().enumerate() {
            for now_ns in 1..=5 {
                keeper.save(10 * now_ns - k as i64, format!("{k} {now_ns}").as_bytes()).unwrap();
            }
        }
        let newest = of(0, 2).newest(60).unwrap().unwrap();
        assert_eq!((newest.state.as_slice(), newest.generation), (b"0 5".as_slice(), 0));
        assert_eq!(newest.age, Duration::from_nanos(10));
        assert_eq!(of(0, 0).newest(60).unwrap().unwrap().state, b"1 5", "not its own");
        assert_eq!(of(1, 7).newest(60).unwrap().unwrap().state, b"2 5");
    }

    #[test]
    fn the_newest_counts_and_few_are_kept() {
        let folder = tempfile::tempdir().unwrap();
        let of = |generation| states(folder.path(), 0, generation);
        for generation in 0..100 {
            of(generation).keeper().unwrap().save(i64::from(generation), b"state").unwrap();
        }
        let newest = of(100).newest(1_000_000).unwrap().unwrap();
        assert_eq!((newest.generation, newest.age), (99, Duration::from_nanos(999_901)));
        assert_eq!(
            of(100).files().unwrap().into_keys().collect::<Vec<_>>(),
            (92..100).collect::<Vec<_>>()
        );
    }

    #[test]
    fn a_process_that_runs_keeps_its_file_however_many_successors_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let of = |generation| states(folder.path(), 0, generation);
        let mut old = of(0).keeper().unwrap();
        for generation in 1..30 {
            let now_ns = i64::from(generation) * 1000;
            of(generation).keeper().unwrap().save(now_ns, b"refused").unwrap();
            old.save(now_ns + 1, b"old").unwrap();
        }
        let newest = of(30).newest(30_000).unwrap().unwrap();
        assert_eq!((newest.state.as_slice(), newest.generation), (b"old".as_slice(), 0));
    }

    #[test]
    fn what_was_not_written_to_its_end_does_not_count() {
        let folder = tempfile::tempdir().unwrap();
        let of = |generation| states(folder.path(), 0, generation);
        let mut keeper = of(0).keeper().unwrap();
        keeper.save(1, b"whole").unwrap();
        keeper.save(2, &[7; 10_000]).unwrap();
        let path = folder.path().join("state/fusion.0.0");
        let file = File::options().write(true).open(&path).unwrap();
        file.set_len(PLACE_BYTES + 4096).unwrap();
        assert_eq!(of(1).newest(3).unwrap().unwrap().state, b"whole");
        // As if the process had been killed while it wrote over an older state of the same length.
        file.write_all_at(&9_i64.to_le_bytes(), 0).unwrap();
        assert_eq!(of(1).newest(10).unwrap(), None);
        let too_long = keeper.save(3, &vec![0; PLACE_BYTES as usize]).unwrap_err();
        assert_eq!(too_long.kind(), io::ErrorKind::FileTooLarge);
    }
}
