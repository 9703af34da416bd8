//! Makes a whole recording of what can be read of a broken one.

use std::path::Path;

use crate::error::RecordingError;
use crate::file::RecordingFile;
use crate::reader::{Ending, RecordingReader};
use crate::writer::RecordingWriter;

/// What was recovered.
#[derive(Debug)]
pub struct Recovered {
    /// Messages that are in the new file.
    pub messages: u64,
    /// What ended the reading of the old one; `None`: its own end, or where it was cut off.
    pub damage: Option<RecordingError>,
    /// Whether nothing was wrong with it.
    pub was_whole: bool,
}

/// Copies what can be read of the recording `from` to a new one, `to`, with an index.
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
