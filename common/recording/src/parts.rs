//! Recordings that were split: `flight.mcap`, `flight-1.mcap` and so on.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use crate::RecordingError;
use crate::reader::RecordingReader;

/// The next file of a split recording, if it exists: `flight.mcap`, `flight-1.mcap` and so on.
fn next(path: &Path, metadata: &BTreeMap<String, String>) -> Option<PathBuf> {
    let number: u64 = metadata.get("file")?.parse().ok()?;
    let stem = path.file_stem()?.to_str()?;
    let extension = path.extension()?.to_str()?;
    let first = match number {
        0 => stem,
        number => stem.strip_suffix(&format!("-{number}"))?,
    };
    let next = path.with_file_name(format!("{first}-{}.{extension}", number.checked_add(1)?));
    next.is_file().then_some(next)
}

impl RecordingReader {
    /// Opens the file that continues this one, if the recording was split.
    ///
    /// # Errors
    /// The file exists and cannot be read: as [`RecordingReader::open`].
    pub fn next_part(&self) -> Result<Option<Self>, RecordingError> {
        let Some(path) = next(self.path(), &self.about().metadata) else { return Ok(None) };
        let reader = Self::open(&path)?;
        Ok(is_same_flight(self, &reader).then_some(reader))
    }
}

/// Whether one file continues another.
fn is_same_flight(one: &RecordingReader, next: &RecordingReader) -> bool {
    let about = |reader: &RecordingReader, key: &str| reader.about().metadata.get(key).cloned();
    let number =
        |reader: &RecordingReader| about(reader, "file").and_then(|text| text.parse::<u64>().ok());
    let is_next = number(one).zip(number(next)).is_some_and(|(one, next)| next == one + 1);
    let keys = ["instance", "observer", "utc_from_monotonic_ns", "utc_from_exposure_ns"];
    is_next && keys.iter().all(|key| about(one, key) == about(next, key))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn parts_are_named_as_the_recorder_names_them() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        std::fs::write(path("a-1.mcap"), "").unwrap();
        std::fs::write(path("a-2.mcap"), "").unwrap();
        let following = |name: &str, number: &str| {
            let metadata = BTreeMap::from([("file".to_owned(), number.to_owned())]);
            next(&path(name), &metadata)
        };
        assert_eq!(following("a.mcap", "0"), Some(path("a-1.mcap")));
        assert_eq!(following("a-1.mcap", "1"), Some(path("a-2.mcap")));
        assert_eq!(following("a-2.mcap", "2"), None);
        // The file was renamed.
        assert_eq!(following("b.mcap", "1"), None);
        assert_eq!(following("a.mcap", "none"), None);
    }
}
