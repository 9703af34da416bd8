//! Files of keys and certificates.

use std::fs::{self, File, OpenOptions};
use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::Path;

use crate::error::IdentityError;

/// Maximum length of a file, bytes; valid ones are shorter.
const MOST_BYTES: u64 = 1 << 20;

fn failed(path: &Path, what: &'static str) -> impl FnOnce(std::io::Error) -> IdentityError {
    move |source| IdentityError::File { path: path.into(), what, source }
}

pub(crate) fn read(path: &Path) -> Result<String, IdentityError> {
    read_from(path, &File::open(path).map_err(failed(path, "open"))?)
}

/// Reads a private key, which others must not be able to read.
pub(crate) fn read_private(path: &Path) -> Result<String, IdentityError> {
    let file = File::open(path).map_err(failed(path, "open"))?;
    // The mode is that of the opened file, so that no other file can replace it meanwhile.
    let mode = file.metadata().map_err(failed(path, "open"))?.mode() & 0o777;
    if mode & 0o077 != 0 {
        return Err(IdentityError::Exposed { path: path.into(), mode });
    }
    read_from(path, &file)
}

fn read_from(path: &Path, file: &File) -> Result<String, IdentityError> {
    let mut text = String::new();
    file.take(MOST_BYTES + 1).read_to_string(&mut text).map_err(failed(path, "read"))?;
    if text.len() as u64 > MOST_BYTES {
        let reason = format!("it has more than {MOST_BYTES} bytes, so it is none of ours");
        return Err(IdentityError::Content { path: path.into(), reason });
    }
    Ok(text)
}

/// Reads all lines of a file that grows.
pub(crate) fn read_lines(path: &Path) -> Result<Vec<String>, IdentityError> {
    let file = File::open(path).map_err(failed(path, "open"))?;
    BufReader::new(file).lines().collect::<Result<_, _>>().map_err(failed(path, "read"))
}

/// Appends a line to such a file, and waits until it is on disk.
pub(crate) fn append(path: &Path, line: &str) -> Result<(), IdentityError> {
    let file = OpenOptions::new().append(true).create(true).open(path);
    let mut file = file.map_err(failed(path, "open"))?;
    writeln!(file, "{line}").map_err(failed(path, "write"))?;
    file.sync_all().map_err(failed(path, "write"))
}

/// Locks a folder against other programs that use this lock, until the file is dropped.
pub(crate) fn lock_folder(path: &Path) -> Result<File, IdentityError> {
    let folder = File::open(path).map_err(failed(path, "open"))?;
    folder.lock().map_err(failed(path, "lock"))?;
    Ok(folder)
}

/// Writes a file that every user can read.
pub(crate) fn write(path: &Path, text: &str) -> Result<(), IdentityError> {
    write_as(path, text, 0o644)
}

pub(crate) fn write_private(path: &Path, text: &str) -> Result<(), IdentityError> {
    write_as(path, text, 0o600)
}

/// Writes a file completely or not at all, even if the machine loses power.
fn write_as(path: &Path, text: &str, mode: u32) -> Result<(), IdentityError> {
    let new = path.with_extension("new");
    // A file of an interrupted run would keep its mode.
    drop(fs::remove_file(&new));
    let mut file = OpenOptions::new()
        .write(true)
        .create_new(true)
        .mode(mode)
        .open(&new)
        .map_err(failed(&new, "create"))?;
    file.write_all(text.as_bytes()).map_err(failed(&new, "write"))?;
    file.sync_all().map_err(failed(&new, "write"))?;
    fs::rename(&new, path).map_err(failed(path, "replace"))
}

pub(crate) fn make_folder(path: &Path) -> Result<(), IdentityError> {
    fs::create_dir_all(path).map_err(failed(path, "create"))
}
