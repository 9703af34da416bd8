//! A file that always contains whole records. A failed write is undone, and disk space is reserved
//! for the index.

use std::fs::{File, OpenOptions};
use std::io::{Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use rustix::fs::{FlockOperation, fdatasync, flock, fstatvfs};

use crate::error::RecordingError;

/// Disk space that is left free, bytes. The file's index needs it, and a full disk stops other
/// programs.
const RESERVE_BYTES: u64 = 16_000_000;

/// The free disk space is checked each time this many bytes were written.
const LOOK_EACH: u64 = 1_000_000;

/// A file that one process writes.
#[derive(Debug)]
pub struct RecordingFile {
    path: PathBuf,
    file: File,
    /// Size of the whole records, bytes.
    bytes: u64,
    /// File size at which the free disk space is checked again, bytes.
    look_at: u64,
    /// Disk space that is left free, bytes.
    reserve_bytes: u64,
}

impl RecordingFile {
    /// Creates the file and locks it for this process.
    ///
    /// # Errors
    /// [`RecordingError::Locked`], [`RecordingError::Exists`] or [`RecordingError::File`].
    pub fn create(path: &Path) -> Result<Self, RecordingError> {
        let path = path.to_owned();
        let opened =
            OpenOptions::new().create(true).truncate(false).read(true).write(true).open(&path);
        let file = opened.map_err(|error| RecordingError::File { path: path.clone(), error })?;
        if flock(&file, FlockOperation::NonBlockingLockExclusive).is_err() {
            return Err(RecordingError::Locked { path });
        }
        let metadata = file.metadata();
        let metadata =
            metadata.map_err(|error| RecordingError::File { path: path.clone(), error })?;
        if metadata.len() > 0 {
            return Err(RecordingError::Exists { path });
        }
        Ok(Self { path, file, bytes: 0, look_at: 0, reserve_bytes: RESERVE_BYTES })
    }

    /// Sets the disk space that is left free.
    pub fn leave_free(&mut self, bytes: u64) {
        (self.reserve_bytes, self.look_at) = (bytes, 0);
    }

    /// The path of the file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The size of the file, bytes.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Appends bytes, all of them or none.
    ///
    /// # Errors
    /// [`RecordingError::DiskFull`] while the reserved space is still free;
    /// [`RecordingError::File`].
    pub fn append(&mut self, bytes: &[u8]) -> Result<(), RecordingError> {
        let end = self.bytes + bytes.len() as u64;
        if end >= self.look_at {
            let free = self.free_bytes()?;
            if free < self.reserve_bytes.saturating_add(bytes.len() as u64) {
                let free_mb = free / 1_000_000;
                return Err(RecordingError::DiskFull { path: self.path.clone(), free_mb });
            }
            self.look_at = end + LOOK_EACH;
        }
        self.append_last(bytes)
    }

    /// Appends the last bytes. They may use the reserved disk space.
    pub fn append_last(&mut self, bytes: &[u8]) -> Result<(), RecordingError> {
        let Err(error) = self.file.write_all(bytes) else {
            self.bytes += bytes.len() as u64;
            return Ok(());
        };
        // Removes an incomplete record. If that fails too, readers skip the incomplete record at
        // the end.
        let restored = self.file.set_len(self.bytes);
        drop(restored.and_then(|()| self.file.seek(SeekFrom::Start(self.bytes))));
        Err(RecordingError::File { path: self.path.clone(), error })
    }

    /// Waits until the bytes are on the disk.
    pub fn sync(&self) -> Result<(), RecordingError> {
        fdatasync(&self.file)
            .map_err(|error| RecordingError::File { path: self.path.clone(), error: error.into() })
    }

    fn free_bytes(&self) -> Result<u64, RecordingError> {
        let space = fstatvfs(&self.file).map_err(|error| RecordingError::File {
            path: self.path.clone(),
            error: error.into(),
        })?;
        Ok(space.f_bavail.saturating_mul(space.f_frsize))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_file_has_one_writer_and_is_not_overwritten() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("flight.mcap");
        let mut first = RecordingFile::create(&path).unwrap();
        let error = RecordingFile::create(&path).unwrap_err().to_string();
        assert!(error.contains("being written by another recorder. Cure:"), "{error}");
        first.append(b"something").unwrap();
        drop(first);
        let error = RecordingFile::create(&path).unwrap_err().to_string();
        assert!(error.contains("is there already. Cure:"), "{error}");
        let error = RecordingFile::create(&folder.path().join("no/flight.mcap")).unwrap_err();
        assert!(error.to_string().contains("no/flight.mcap: No such file"), "{error}");
    }

    #[test]
    fn a_write_that_fails_leaves_what_was_whole() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("flight.mcap");
        let mut file = RecordingFile::create(&path).unwrap();
        file.append(b"whole").unwrap();
        // A file that is open for reading alone refuses to be written to, whatever the disk has.
        let writable = std::mem::replace(&mut file.file, File::open(&path).unwrap());
        let error = file.append(b"more").unwrap_err().to_string();
        assert!(error.contains("flight.mcap: Bad file descriptor"), "{error}");
        assert_eq!(file.bytes(), 5);
        file.file = writable;
        file.append(b" again").unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"whole again");
    }
}
