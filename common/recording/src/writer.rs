//! Writes a recording.
//!
//! The MCAP library writes to memory. From there only whole records go to the file. So a failed
//! write never leaves the library in an unknown state, and the file is always readable.

use std::collections::BTreeMap;
use std::io::Write;
use std::sync::{Arc, Mutex, PoisonError};

use mcap::records::{MessageHeader, Metadata};
use mcap::write::NoSeek;
use mcap::{Attachment, Compression, WriteOptions, Writer};

use crate::channel::ChannelKind;
use crate::error::RecordingError;
use crate::file::RecordingFile;

/// The name of the metadata record at the beginning of every recording.
pub(crate) const METADATA: &str = "flockeye";

/// The largest message, bytes: a frame of 8192x8192 pixels. Readers refuse larger ones before they
/// allocate memory.
pub const LARGEST_MESSAGE: usize = 67_108_864;

/// Size of a chunk before compression, bytes. A larger one is ended.
const CHUNK_BYTES: u64 = 1 << 20;

/// The metadata and attachments of a recording.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct About {
    /// UTC minus CLOCK_MONOTONIC, nanoseconds. Times of messages are UTC.
    pub utc_from_monotonic_ns: i64,
    /// Names and values that describe the recording.
    pub metadata: BTreeMap<String, String>,
    /// Attached files: name, media type and bytes.
    pub attachments: Vec<(String, String, Vec<u8>)>,
}

/// Bytes that are not yet in the file.
#[derive(Debug, Clone, Default)]
struct Spool(Arc<Mutex<Vec<u8>>>);

impl Spool {
    fn take(&self) -> Vec<u8> {
        // A thread that panicked while it held the lock left the bytes valid.
        std::mem::take(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

impl Write for Spool {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

/// A recording that is being written.
pub struct RecordingWriter {
    mcap: Writer<NoSeek<Spool>>,
    spool: Spool,
    file: RecordingFile,
    /// Number of each channel, and sequence number of its next message.
    channels: BTreeMap<ChannelKind, (u16, u32)>,
    utc_from_monotonic_ns: i64,
}

impl RecordingWriter {
    /// Begins a recording.
    pub fn begin(file: RecordingFile, about: &About) -> Result<Self, RecordingError> {
        let spool = Spool::default();
        let options = WriteOptions::new()
            .profile("ros2")
            .library(concat!("flockeye ", env!("CARGO_PKG_VERSION")))
            .compression(Some(Compression::Zstd))
            // The fastest level: a recorder must leave the processor to the flight.
            .compression_level(1)
            .compression_threads(0)
            .chunk_size(Some(CHUNK_BYTES))
            .disable_seeking(true);
        let mut mcap = options.create(NoSeek::new(spool.clone()))?;
        let mut metadata = about.metadata.clone();
        let offset = about.utc_from_monotonic_ns.to_string();
        metadata.insert("utc_from_monotonic_ns".to_owned(), offset);
        mcap.write_metadata(&Metadata { name: METADATA.to_owned(), metadata })?;
        for (name, media_type, data) in &about.attachments {
            mcap.attach(&Attachment {
                log_time: 0,
                create_time: 0,
                name: name.clone(),
                media_type: media_type.clone(),
                data: data.into(),
            })?;
        }
        let channels = BTreeMap::new();
        let utc_from_monotonic_ns = about.utc_from_monotonic_ns;
        let mut writer = Self { mcap, spool, file, channels, utc_from_monotonic_ns };
        writer.move_to_file()?;
        Ok(writer)
    }

    /// Writes a message that arrived at `at_ns`, CLOCK_MONOTONIC. Returns its sequence number.
    ///
    /// # Errors
    /// [`RecordingError::DiskFull`]: end the recording. [`RecordingError::File`]: earlier messages
    /// are in the file. [`RecordingError::Message`]: the message is too large, and the recording
    /// continues.
    pub fn write(
        &mut self,
        kind: &ChannelKind,
        at_ns: i64,
        message: &[u8],
    ) -> Result<u32, RecordingError> {
        let utc_ns = at_ns.saturating_add(self.utc_from_monotonic_ns);
        let utc_ns = u64::try_from(utc_ns).unwrap_or(0);
        let sequence = self.channels.get(kind).map_or(0, |(_, next)| *next);
        self.write_as(kind, sequence, utc_ns, message)?;
        Ok(sequence)
    }

    /// Writes a message with this sequence number and this time, UTC nanoseconds.
    pub fn write_as(
        &mut self,
        kind: &ChannelKind,
        sequence: u32,
        utc_ns: u64,
        message: &[u8],
    ) -> Result<(), RecordingError> {
        if message.len() > LARGEST_MESSAGE {
            let (channel, length) = (kind.topic.clone(), message.len());
            let reason = format!("has {length} bytes; a recording takes {LARGEST_MESSAGE} at most");
            return Err(RecordingError::Message { channel, reason });
        }
        let channel_id = match self.channels.get_mut(kind) {
            Some((id, next)) => {
                *next = sequence.wrapping_add(1);
                *id
            }
            None => self.add(kind, sequence)?,
        };
        let header = MessageHeader { channel_id, sequence, log_time: utc_ns, publish_time: utc_ns };
        self.mcap.write_to_known_channel(&header, message)?;
        self.move_to_file()
    }

    fn add(&mut self, kind: &ChannelKind, sequence: u32) -> Result<u16, RecordingError> {
        let schema = self.mcap.add_schema(&kind.message, "ros2msg", kind.definition.as_bytes())?;
        let id = self.mcap.add_channel(schema, &kind.topic, "cdr", &BTreeMap::new())?;
        self.channels.insert(kind.clone(), (id, sequence.wrapping_add(1)));
        Ok(id)
    }

    /// Ends the chunk and waits until it is on the disk. A later crash cannot lose earlier
    /// messages.
    pub fn flush(&mut self) -> Result<(), RecordingError> {
        self.mcap.flush()?;
        self.move_to_file()?;
        self.file.sync()
    }

    /// Sets the disk space that is left free, instead of 16 MB.
    pub fn leave_free(&mut self, bytes: u64) {
        self.file.leave_free(bytes);
    }

    /// The size of the file, bytes.
    pub fn bytes(&self) -> u64 {
        self.file.bytes()
    }

    /// The path of the file.
    pub fn path(&self) -> &std::path::Path {
        self.file.path()
    }

    /// Ends the recording with its index. Returns the size of the file, bytes.
    ///
    /// # Errors
    /// [`RecordingError::File`]: the file has no index, but can be read.
    pub fn finish(mut self) -> Result<u64, RecordingError> {
        self.mcap.finish()?;
        self.file.append_last(&self.spool.take())?;
        self.file.sync()?;
        Ok(self.file.bytes())
    }

    fn move_to_file(&mut self) -> Result<(), RecordingError> {
        let bytes = self.spool.take();
        if bytes.is_empty() {
            return Ok(());
        }
        match self.file.append(&bytes) {
            // The reserved disk space is enough for these bytes and the index. `finish` writes
            // both.
            Err(error @ RecordingError::DiskFull { .. }) => {
                self.spool.clone().write_all(&bytes).ok();
                Err(error)
            }
            other => other,
        }
    }
}
