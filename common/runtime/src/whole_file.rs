//! Atomic files: a reader finds the whole file or none, even if the writer is killed.

use std::ffi::OsString;
use std::fs;
use std::io;
use std::path::Path;

/// Writes a file beside its place and moves it there. Until then the former file stays.
///
/// # Errors
/// The system's reason; nothing of the new file is left then.
pub fn write_whole(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut fresh = OsString::from(path);
    fresh.push(".new");
    fs::write(&fresh, bytes).and_then(|()| fs::rename(&fresh, path)).inspect_err(|_| {
        // On a full disk, a partial file would only take space.
        fs::remove_file(&fresh).ok();
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_file_is_replaced_as_a_whole_and_a_failure_leaves_the_one_of_before() {
        let scratch = tempfile::tempdir().unwrap();
        let path = scratch.path().join("a.json");
        write_whole(&path, b"one").unwrap();
        write_whole(&path, b"two").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"two");
        // It cannot be moved onto a folder that is not empty.
        let folder = scratch.path().join("folder");
        fs::create_dir_all(folder.join("full")).unwrap();
        write_whole(&folder, b"three").unwrap_err();
        let mut left: Vec<_> =
            fs::read_dir(scratch.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
        left.sort();
        assert_eq!(left, ["a.json", "folder"]);
    }
}
