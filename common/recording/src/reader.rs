//! Reads a recording from its beginning to its end, also one that was cut off.
//!
//! Nothing that a file says takes more memory than [`LARGEST_MESSAGE`] and some.

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

/// What a record or a chunk has beside a large message, bytes at most.
pub(crate) const RECORD_BYTES: usize = 4_194_304;

/// A message of a recording.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RecordedMessage {
    /// Its channel.
    pub channel: Arc<ChannelKind>,
    /// Its number in the channel.
    pub sequence: u32,
    /// When it came, UTC nanoseconds.
    pub utc_ns: u64,
    /// Its bytes, CDR.
    pub bytes: Vec<u8>,
}

/// How a recording ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ending {
    /// With its index.
    Whole,
    /// Without: its recorder was killed, or the disk was full.
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
    schemas: BTreeMap<u16, (String, String)>,
    channels: BTreeMap<u16, Arc<ChannelKind>>,
    chunk: Chunk,
    has_messages: bool,
    /// A message, or damage, that came while the beginning was read.
    first: Option<Result<RecordedMessage, RecordingError>>,
    ending: Option<Ending>,
}

/// What a record was.
enum ReadRecord {
    Message(RecordedMessage),
    Beginning,
    Other,
    End(Ending),
}

impl RecordingReader {
    /// Opens a recording and reads what it says of itself.
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
            // What is in them is unpacked here, under stricter checks than the library's.
            .with_emit_chunks(true)
            .with_record_length_limit(LARGEST_MESSAGE + RECORD_BYTES);
        let mut reader = Self {
            path,
            file,
            linear: LinearReader::new_with_options(options),
            read: 0,
            about: About::default(),
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

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// What the recording says of itself.
    pub fn about(&self) -> &About {
        &self.about
    }

    /// How it ends, once [`RecordingReader::next_message`] has given the last message.
    pub fn ending(&self) -> Option<Ending> {
        self.ending
    }

    /// The next message, in the order in which they were recorded; `None` at the end.
    pub fn next_message(&mut self) -> Result<Option<RecordedMessage>, RecordingError> {
        if let Some(first) = self.first.take() {
            return first.map(Some);
        }
        while self.ending.is_none() {
            match self.next_record()? {
                ReadRecord::Message(message) => return Ok(Some(message)),
                ReadRecord::End(ending) => self.ending = Some(ending),
                ReadRecord::Beginning | ReadRecord::Other => {}
            }
        }
        Ok(None)
    }

    fn read_beginning(&mut self) -> Result<(), RecordingError> {
        let mut is_known = false;
        loop {
            match self.next_record() {
                Ok(ReadRecord::Beginning) => is_known = true,
                Ok(ReadRecord::Other) => {}
                Ok(ReadRecord::Message(message)) => self.first = Some(Ok(message)),
                Ok(ReadRecord::End(ending)) => self.ending = Some(ending),
                // What the recording says of itself is known all the same.
                Err(damage) if is_known => self.first = Some(Err(damage)),
                Err(damage) => return Err(damage),
            }
            if self.first.is_some() || self.ending.is_some() {
                break;
            }
        }
        if is_known {
            return Ok(());
        }
        let path = self.path.clone();
        let reason = match self.ending {
            Some(Ending::Cut) if self.read < 64 => "it ends within its beginning".to_owned(),
            _ => format!("it has no metadata '{METADATA}' at its beginning"),
        };
        Err(RecordingError::Foreign { path, reason })
    }

    fn next_record(&mut self) -> Result<ReadRecord, RecordingError> {
        let in_chunk = self.chunk.next_record();
        let in_chunk = in_chunk.map_err(|reason| damaged(&self.path, self.read, &reason))?;
        if let Some(record) = in_chunk {
            return self.understand(record);
        }
        loop {
            let outcome = match self.linear.next_event() {
                None => return Ok(ReadRecord::End(Ending::Whole)),
                Some(Ok(LinearReadEvent::ReadRequest(wanted))) => Ok(wanted),
                Some(Ok(LinearReadEvent::Record { opcode, data })) => {
                    // A record of this kind is none: the rest of a file that a crash left as zeros.
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
                Err(Err(McapError::UnexpectedEof)) => return Ok(ReadRecord::End(Ending::Cut)),
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

    fn understand(&mut self, record: Record<'static>) -> Result<ReadRecord, RecordingError> {
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
                return Ok(ReadRecord::Message(RecordedMessage {
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
                return Ok(ReadRecord::Beginning);
            }
            // Only what stands before the messages says something of the recording. What others
            // have added behind them may be of any size and number.
            Record::Attachment { header, data, .. } if !self.has_messages => {
                let attached = (header.name, header.media_type, data.into_owned());
                self.about.attachments.push(attached);
            }
            _ => {}
        }
        Ok(ReadRecord::Other)
    }
}

pub(crate) fn damaged(path: &Path, offset: u64, reason: &str) -> RecordingError {
    RecordingError::Damaged { path: path.to_owned(), offset, reason: reason.to_owned() }
}
