//! Makes a whole recording from the readable part of a damaged one.

use std::path::Path;

use crate::error::RecordingError;
use crate::file::RecordingFile;
use crate::reader::{Ending, RecordingReader};
use crate::writer::RecordingWriter;

/// The result of a recovery.
#[derive(Debug)]
pub struct Recovered {
    /// Number of messages in the new file.
    pub messages: u64,
    /// The error that ended the reading of the old file. `None`: its end, or the place where it was
    /// cut off.
    pub damage: Option<RecordingError>,
    /// Whether the old file was already whole.
    pub was_whole: bool,
}

/// Copies the readable part of the recording `from` to a new one, `to`, with an index.
pub fn recover(from: &Path, to: &Path) -> Result<Recovered, RecordingError> {
    let mut reader = RecordingReader::open(from)?;
    let mut writer = RecordingWriter::begin(RecordingFile::create(to)?, reader.about())?;
    let mut messages = 0;
    let damage = loop {
        match reader.next_message() {
            Ok(Some(message)) => {
                let (kind, sequence) = (&message.channel, message.sequence);
                writer.write_as(kind, sequence, message.utc_ns, &message.bytes)?;
                messages += 1;
            }
            Ok(None) => break None,
            Err(damage) => break Some(damage),
        }
    };
    writer.finish()?;
    Ok(Recovered { messages, damage, was_whole: reader.ending() == Some(Ending::Whole) })
}
