//! Reads a recording from its beginning to its end, also an incomplete one.
//!
//! No content of a file, damaged or not, can take much more memory than [`LARGEST_MESSAGE`].

use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use mcap::McapError;
use mcap::records::Record;
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};

use crate::channel::ChannelKind;
use crate::chunk::Chunk;
use crate::error::RecordingError;
use crate::writer::{About, LARGEST_MESSAGE, METADATA};

/// Largest size of a record or a chunk beyond its largest message, bytes.
pub(crate) const RECORD_BYTES: usize = 4_194_304;

/// A message of a recording.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RecordedMessage {
    /// The message's channel.
    pub channel: Arc<ChannelKind>,
    /// Sequence number in the channel.
    pub sequence: u32,
    /// Time of arrival, UTC nanoseconds.
    pub utc_ns: u64,
    /// The message in CDR.
    pub bytes: Vec<u8>,
}

/// The end of a recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ending {
    /// With an index.
    Whole,
    /// Without an index: the recorder was killed, or the disk was full.
    Cut,
}

/// A recording that is being read.
pub struct RecordingReader {
    path: PathBuf,
    file: File,
    linear: LinearReader,
    /// Bytes that were read from the file.
    read: u64,
    about: About,
    /// Whether the metadata of the recording were read.
    has_metadata: bool,
    schemas: BTreeMap<u16, (String, String)>,
    channels: BTreeMap<u16, Arc<ChannelKind>>,
    chunk: Chunk,
    has_messages: bool,
    /// A message or an error that was read together with the beginning.
    first: Option<Result<RecordedMessage, RecordingError>>,
    ending: Option<Ending>,
}

impl RecordingReader {
    /// Opens a recording and reads its metadata.
    ///
    /// # Errors
    /// [`RecordingError::File`], [`RecordingError::Empty`], [`RecordingError::NotMcap`],
    /// [`RecordingError::Foreign`] and [`RecordingError::Damaged`].
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        let path = path.to_owned();
        let failed = |error| RecordingError::File { path: path.clone(), error };
        let file = File::open(&path).map_err(failed)?;
        let metadata = file.metadata().map_err(failed)?;
        if metadata.is_dir() {
            let error = std::io::Error::from(std::io::ErrorKind::IsADirectory);
            return Err(RecordingError::File { path, error });
        }
        if metadata.is_file() && metadata.len() == 0 {
            return Err(RecordingError::Empty { path });
        }
        let options = LinearReaderOptions::default()
            // Chunks are decompressed here, with stricter checks than in the library.
            .with_emit_chunks(true)
            .with_record_length_limit(LARGEST_MESSAGE + RECORD_BYTES);
        let mut reader = Self {
            path,
            file,
            linear: LinearReader::new_with_options(options),
            read: 0,
            about: About::default(),
            has_metadata: false,
            schemas: BTreeMap::new(),
            channels: BTreeMap::new(),
            chunk: Chunk::default(),
            has_messages: false,
            first: None,
            ending: None,
        };
        reader.read_beginning()?;
        Ok(reader)
    }

    /// The path of the file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The metadata of the recording.
    pub fn about(&self) -> &About {
        &self.about
    }

    /// The end of the recording, after [`RecordingReader::next_message`] has returned the last
    /// message.
    pub fn ending(&self) -> Option<Ending> {
        self.ending
    }

    /// The next message in the order of recording; `None` at the end.
    pub fn next_message(&mut self) -> Result<Option<RecordedMessage>, RecordingError> {
        if let Some(first) = self.first.take() {
            return first.map(Some);
        }
        while self.ending.is_none() {
            if let Some(message) = self.next_record()? {
                return Ok(Some(message));
            }
        }
        Ok(None)
    }

    fn read_beginning(&mut self) -> Result<(), RecordingError> {
        while self.first.is_none() && self.ending.is_none() {
            match self.next_record() {
                Ok(message) => self.first = message.map(Ok),
                // The metadata are valid although the rest is damaged.
                Err(damage) if self.has_metadata => self.first = Some(Err(damage)),
                Err(damage) => return Err(damage),
            }
        }
        if self.has_metadata {
            return Ok(());
        }
        let path = self.path.clone();
        let reason = match self.ending {
            Some(Ending::Cut) if self.read < 64 => "it ends within its beginning".to_owned(),
            _ => format!("it has no metadata '{METADATA}' at its beginning"),
        };
        Err(RecordingError::Foreign { path, reason })
    }

    /// Reads a record. Returns it if it is a message; sets `ending` at the end.
    fn next_record(&mut self) -> Result<Option<RecordedMessage>, RecordingError> {
        let in_chunk = self.chunk.next_record();
        let in_chunk = in_chunk.map_err(|reason| damaged(&self.path, self.read, &reason))?;
        if let Some(record) = in_chunk {
            return self.understand(record);
        }
        loop {
            let outcome = match self.linear.next_event() {
                None => {
                    self.ending = Some(Ending::Whole);
                    return Ok(None);
                }
                Some(Ok(LinearReadEvent::ReadRequest(wanted))) => Ok(wanted),
                Some(Ok(LinearReadEvent::Record { opcode, data })) => {
                    // No record has opcode 0. A crash may leave the rest of a file as zeros.
                    if opcode == 0 {
                        return Err(damaged(
                            &self.path,
                            self.read,
                            "zeros where a record should be",
                        ));
                    }
                    match mcap::parse_record(opcode, data) {
                        Ok(record) => Err(Ok(record.into_owned())),
                        Err(error) => Err(Err(error)),
                    }
                }
                Some(Err(error)) => Err(Err(error)),
            };
            match outcome {
                Ok(wanted) => self.fill(wanted)?,
                Err(Ok(record)) => return self.understand(record),
                Err(Err(McapError::UnexpectedEof)) => {
                    self.ending = Some(Ending::Cut);
                    return Ok(None);
                }
                Err(Err(McapError::BadMagic)) if self.read <= mcap::MAGIC.len() as u64 => {
                    return Err(RecordingError::NotMcap { path: self.path.clone() });
                }
                Err(Err(error)) => {
                    return Err(damaged(&self.path, self.read, &error.to_string()));
                }
            }
        }
    }

    fn fill(&mut self, wanted: usize) -> Result<(), RecordingError> {
        let Self { linear, file, .. } = self;
        let count = loop {
            match file.read(linear.insert(wanted)) {
                Err(error) if error.kind() == std::io::ErrorKind::Interrupted => {}
                other => break other,
            }
        };
        let count =
            count.map_err(|error| RecordingError::File { path: self.path.clone(), error })?;
        self.linear.notify_read(count);
        self.read += count as u64;
        Ok(())
    }

    /// Takes a record. Returns it if it is a message.
    fn understand(
        &mut self,
        record: Record<'static>,
    ) -> Result<Option<RecordedMessage>, RecordingError> {
        match record {
            Record::Schema { header, data } => {
                let definition = String::from_utf8_lossy(&data).into_owned();
                self.schemas.insert(header.id, (header.name, definition));
            }
            Record::Channel(channel) => {
                let known = self.schemas.get(&channel.schema_id).cloned();
                let (message, definition) = known.unwrap_or_default();
                let kind = ChannelKind { topic: channel.topic, message, definition };
                self.channels.insert(channel.id, Arc::new(kind));
            }
            Record::Message { header, data } => {
                self.has_messages = true;
                let Some(channel) = self.channels.get(&header.channel_id) else {
                    let reason = format!("a message of the unknown channel {}", header.channel_id);
                    return Err(damaged(&self.path, self.read, &reason));
                };
                return Ok(Some(RecordedMessage {
                    channel: channel.clone(),
                    sequence: header.sequence,
                    utc_ns: header.log_time,
                    bytes: data.into_owned(),
                }));
            }
            Record::Chunk { header, data } => {
                self.has_messages = true;
                let chunk = Chunk::of(&header, &data, LARGEST_MESSAGE + RECORD_BYTES);
                self.chunk = chunk.map_err(|reason| damaged(&self.path, self.read, &reason))?;
            }
            Record::Metadata(metadata) if metadata.name == METADATA => {
                let offset = metadata.metadata.get("utc_from_monotonic_ns");
                let offset = offset.and_then(|text| text.parse().ok());
                self.about.utc_from_monotonic_ns = offset.unwrap_or(0);
                self.about.metadata = metadata.metadata;
                self.has_metadata = true;
            }
            // Only attachments before the messages describe the recording. Other programs may add
            // later ones, in any size and number.
            Record::Attachment { header, data, .. } if !self.has_messages => {
                let attached = (header.name, header.media_type, data.into_owned());
                self.about.attachments.push(attached);
            }
            _ => {}
        }
        Ok(None)
    }
}

pub(crate) fn damaged(path: &Path, offset: u64, reason: &str) -> RecordingError {
    RecordingError::Damaged { path: path.to_owned(), offset, reason: reason.to_owned() }
}
