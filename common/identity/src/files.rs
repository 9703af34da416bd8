//! Files of keys and certificates.

use std::fs::{self, File, OpenOptions};
use std::io::{Read, Write};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::Path;

use crate::error::IdentityError;

/// A longer file is none of ours.
const MOST_BYTES: u64 = 1 << 20;

fn failed(path: &Path, what: &'static str) -> impl FnOnce(std::io::Error) -> IdentityError {
    move |source| IdentityError::File { path: path.into(), what, source }
}

/// The text of a file.
pub(crate) fn read(path: &Path) -> Result<String, IdentityError> {
    read_from(path, &File::open(path).map_err(failed(path, "open"))?)
}

/// The text of a private key, which nobody else may read.
pub(crate) fn read_private(path: &Path) -> Result<String, IdentityError> {
    let file = File::open(path).map_err(failed(path, "open"))?;
    // The opened file is asked, so that no other can be put in its place meanwhile.
    let mode = file.metadata().map_err(failed(path, "open"))?.mode() & 0o777;
    if mode & 0o077 != 0 {
        return Err(IdentityError::Exposed { path: path.into(), mode });
    }
    read_from(path, &file)
}

fn read_from(path: &Path, file: &File) -> Result<String, IdentityError> {
    let mut text = String::new();
    file.take(MOST_BYTES).read_to_string(&mut text).map_err(failed(path, "read"))?;
    Ok(text)
}

/// Writes a file that everybody may read.
pub(crate) fn write(path: &Path, text: &str) -> Result<(), IdentityError> {
    write_as(path, text, 0o644)
}

/// Writes a private key.
pub(crate) fn write_private(path: &Path, text: &str) -> Result<(), IdentityError> {
    write_as(path, text, 0o600)
}

/// The file is there whole or not at all, also when the machine loses power.
fn write_as(path: &Path, text: &str, mode: u32) -> Result<(), IdentityError> {
    let new = path.with_extension("new");
    // A file of a run that was cut off would keep its mode.
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

/// Makes a folder and those above it.
pub(crate) fn make_folder(path: &Path) -> Result<(), IdentityError> {
    fs::create_dir_all(path).map_err(failed(path, "create"))
}
