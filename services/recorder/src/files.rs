//! Files of a recorder: begin, split and end.

use std::path::{Path, PathBuf};

use flockeye_cli::dated;
use flockeye_recording::file::RecordingFile;
use flockeye_recording::{About, RecordingError, RecordingWriter};

use crate::core::Output;

/// The current file, and counters of all files.
pub(crate) struct Files {
    first: PathBuf,
    about: About,
    split_bytes: Option<u64>,
    writer: Option<RecordingWriter>,
    /// Number of begun files.
    pub(crate) count: u32,
    /// Number of written messages.
    pub(crate) messages: u64,
    /// Total size of the ended files, bytes.
    pub(crate) bytes: u64,
}

impl Files {
    /// Files from `first` on, split at `split_bytes` bytes. No file is created yet.
    pub(crate) fn new(first: &Path, about: About, split_bytes: Option<u64>) -> Self {
        let (writer, count, messages, bytes) = (None, 0, 0, 0);
        Self { first: first.to_owned(), about, split_bytes, writer, count, messages, bytes }
    }

    /// Begins the first file, or the next.
    pub(crate) fn begin(&mut self) -> Result<(), RecordingError> {
        let path = match self.count {
            0 => self.first.clone(),
            count => beside(&self.first, &format!("-{count}")),
        };
        self.begin_at(&path)
    }

    /// UTC for a time of CLOCK_MONOTONIC, with the offset of these files.
    pub(crate) fn utc_ns(&self, at_ns: i64) -> i64 {
        at_ns.saturating_add(self.about.utc_from_monotonic_ns)
    }

    /// Begins a file for a ring's messages, with a date in its name:
    /// `flight-20260102T030405Z.mcap`.
    pub(crate) fn begin_dated(&mut self, utc_ns: i64) -> Result<PathBuf, RecordingError> {
        let since = std::time::Duration::from_nanos(u64::try_from(utc_ns).unwrap_or(0));
        let names = dated::names("", std::time::UNIX_EPOCH + since);
        for name in names {
            let path = beside(&self.first, &name);
            match self.begin_at(&path) {
                // Name in use: second file in one second.
                Err(RecordingError::Exists { .. }) => {}
                other => return other.map(|()| path),
            }
        }
        Err(RecordingError::Exists { path: self.first.clone() })
    }

    fn begin_at(&mut self, path: &Path) -> Result<(), RecordingError> {
        self.about.metadata.insert("file".to_owned(), self.count.to_string());
        let file = RecordingFile::create(path)?;
        let begun = RecordingWriter::begin(file, &self.about).inspect_err(|_| {
            // An incomplete file is useless. The removal may also fail if the disk is full.
            std::fs::remove_file(path).ok();
        });
        self.writer = Some(begun?);
        self.count += 1;
        Ok(())
    }

    /// Begins the next file if the current one has reached its size limit. Messages written between
    /// two calls stay in one file.
    pub(crate) fn split_if_full(&mut self) -> Result<(), RecordingError> {
        let is_full = self
            .writer
            .as_ref()
            .is_some_and(|writer| self.split_bytes.is_some_and(|split| writer.bytes() >= split));
        if is_full {
            self.end()?;
            self.begin()?;
        }
        Ok(())
    }

    /// Writes a message received at `at_ns`, CLOCK_MONOTONIC.
    pub(crate) fn write(
        &mut self,
        at_ns: i64,
        (channel, bytes): &Output,
    ) -> Result<(), RecordingError> {
        if let Some(writer) = &mut self.writer {
            writer.write(channel, at_ns, bytes)?;
            self.messages += 1;
        }
        Ok(())
    }

    /// Flushes written data to the disk.
    pub(crate) fn flush(&mut self) -> Result<(), RecordingError> {
        self.writer.as_mut().map_or(Ok(()), RecordingWriter::flush)
    }

    /// Ends the current file.
    pub(crate) fn end(&mut self) -> Result<(), RecordingError> {
        if let Some(writer) = self.writer.take() {
            self.bytes += writer.finish()?;
        }
        Ok(())
    }
}

/// The path with `added` between name and extension.
fn beside(path: &Path, added: &str) -> PathBuf {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let extension = path.extension().unwrap_or_default().to_string_lossy().into_owned();
    let dot = if extension.is_empty() { "" } else { "." };
    path.with_file_name(format!("{stem}{added}{dot}{extension}"))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use flockeye_recording::{ChannelKind, RecordingReader};
    use std::sync::Arc;

    /// Bytes that cannot be compressed.
    fn noise(seed: u64) -> Vec<u8> {
        let mut state = seed.wrapping_mul(2).wrapping_add(1);
        (0..100_000)
            .map(|_| {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                (state >> 56) as u8
            })
            .collect()
    }

    #[test]
    fn a_recording_is_split_and_no_message_is_lost() {
        let folder = tempfile::tempdir().unwrap();
        let first = folder.path().join("flight.mcap");
        let mut files = Files::new(&first, About::default(), Some(1_000_000));
        files.begin().unwrap();
        let channel = Arc::new(ChannelKind::of_losses());
        for at_ns in 0..40 {
            let output = (channel.clone(), noise(at_ns as u64));
            files.split_if_full().unwrap();
            files.write(at_ns, &output).unwrap();
        }
        files.end().unwrap();
        let Files { count, messages, bytes, .. } = files;
        assert_eq!(messages, 40);
        assert!(count >= 3 && bytes > 4_000_000, "{count} files, {bytes} bytes");
        let mut next = 0;
        for number in 0..count {
            let name =
                if number == 0 { "flight.mcap".into() } else { format!("flight-{number}.mcap") };
            let mut reader = RecordingReader::open(&folder.path().join(name)).unwrap();
            assert_eq!(reader.about().metadata["file"], number.to_string());
            while let Some(message) = reader.next_message().unwrap() {
                assert_eq!(message.bytes, noise(next));
                next += 1;
            }
        }
        assert_eq!(next, 40);
    }

    #[test]
    fn files_of_what_came_before_are_named_by_their_time() {
        let folder = tempfile::tempdir().unwrap();
        let mut files = Files::new(&folder.path().join("lost.mcap"), About::default(), None);
        let named = |path: PathBuf| path.file_name().unwrap().to_string_lossy().into_owned();
        let at_ns = 1_700_000_000_000_000_000;
        assert_eq!(named(files.begin_dated(at_ns).unwrap()), "lost-20231114T221320Z.mcap");
        files.end().unwrap();
        assert_eq!(named(files.begin_dated(at_ns).unwrap()), "lost-20231114T221320Z-1.mcap");
        files.end().unwrap();
    }
}
