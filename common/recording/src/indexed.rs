//! Random access to a recording by its index of chunks. A recording has no index if its recorder
//! was killed. Then one pass over the file makes it.
//!
//! Only one chunk is in memory at a time, so a recording may be larger than the memory.

use std::collections::BTreeMap;
use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use mcap::records::{Record, op};
use mcap::sans_io::summary_reader::{SummaryReadEvent, SummaryReader, SummaryReaderOptions};
use mcap::{McapError, Summary};

use crate::channel::ChannelKind;
use crate::chunk::{Chunk, RECORD_HEAD};
use crate::error::RecordingError;
use crate::reader::{Ending, RECORD_BYTES, RecordingReader, damaged};
use crate::writer::{About, LARGEST_MESSAGE};

/// Largest size of a record, bytes.
const LARGEST_RECORD: usize = LARGEST_MESSAGE + RECORD_BYTES;

/// Position and content of a chunk.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ChunkPlace {
    /// Position of the chunk's record in the file, bytes.
    pub offset: u64,
    /// Size of the chunk's record, bytes.
    pub length: u64,
    /// Time of the first message, UTC nanoseconds.
    pub first_ns: u64,
    /// Time of the last message, UTC nanoseconds.
    pub last_ns: u64,
    /// Numbers of the channels that have messages in the chunk.
    pub channels: Vec<u16>,
}

/// A message of a chunk.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct IndexedMessage {
    /// Number of the channel; see [`IndexedRecording::channels`].
    pub channel: u16,
    /// Time of arrival, UTC nanoseconds.
    pub utc_ns: u64,
    /// The message in CDR.
    pub bytes: Vec<u8>,
}

/// A recording with the positions of its chunks. Several threads may read it at once.
#[derive(Debug)]
pub struct IndexedRecording {
    path: PathBuf,
    file: File,
    about: About,
    channels: BTreeMap<u16, Arc<ChannelKind>>,
    chunks: Vec<ChunkPlace>,
    ending: Ending,
    damage: Option<RecordingError>,
}

impl IndexedRecording {
    /// Opens a recording.
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        let about = RecordingReader::open(path)?.about().clone();
        let path = path.to_owned();
        let failed = |error| RecordingError::File { path: path.clone(), error };
        let file = File::open(&path).map_err(failed)?;
        let bytes = file.metadata().map_err(failed)?.len();
        let mut recording = Self {
            path,
            file,
            about,
            channels: BTreeMap::new(),
            chunks: Vec::new(),
            ending: Ending::Cut,
            damage: None,
        };
        let is_indexed = recording.read_index(bytes);
        if !is_indexed {
            (recording.channels, recording.chunks) = (BTreeMap::new(), Vec::new());
            recording.damage = recording.make_index(bytes).err();
        }
        Ok(recording)
    }

    /// The path of the file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The metadata of the recording.
    pub fn about(&self) -> &About {
        &self.about
    }

    /// The channels by their numbers.
    pub fn channels(&self) -> &BTreeMap<u16, Arc<ChannelKind>> {
        &self.channels
    }

    /// The chunks in the order of the file, which is also the order of their times.
    pub fn chunks(&self) -> &[ChunkPlace] {
        &self.chunks
    }

    /// Whether the recording has an index or was cut off.
    pub fn ending(&self) -> Ending {
        self.ending
    }

    /// The error that ended the pass for an index. Chunks before it can be read.
    pub fn damage(&self) -> Option<&RecordingError> {
        self.damage.as_ref()
    }

    /// Times of the first and the last message, UTC nanoseconds; `None` without messages.
    pub fn span_ns(&self) -> Option<(u64, u64)> {
        let first = self.chunks.iter().map(|chunk| chunk.first_ns).min()?;
        let last = self.chunks.iter().map(|chunk| chunk.last_ns).max()?;
        Some((first, last))
    }

    /// The chunk with the messages of this time: the last one that does not begin later.
    pub fn chunk_at(&self, utc_ns: u64) -> usize {
        self.chunks.partition_point(|chunk| chunk.first_ns <= utc_ns).saturating_sub(1)
    }

    /// The messages of a chunk on the wanted channels, in the order of recording. Empty for a chunk
    /// that does not exist.
    pub fn messages(
        &self,
        chunk: usize,
        is_wanted: impl Fn(u16) -> bool,
    ) -> Result<Vec<IndexedMessage>, RecordingError> {
        let Some(place) = self.chunks.get(chunk) else { return Ok(Vec::new()) };
        if !place.channels.iter().any(|channel| is_wanted(*channel)) {
            return Ok(Vec::new());
        }
        let damaged = |reason: &str| damaged(&self.path, place.offset, reason);
        let length = usize::try_from(place.length).unwrap_or(usize::MAX);
        if !(RECORD_HEAD..=LARGEST_RECORD + RECORD_HEAD).contains(&length) {
            return Err(damaged(&format!("the index has a chunk of {length} bytes")));
        }
        let record = self.bytes(place.offset, length)?;
        let mut chunk = self.unpack(place.offset, &record)?;
        let mut found = Vec::new();
        while let Some(record) = chunk.next_borrowed().map_err(|reason| damaged(&reason))? {
            if let Record::Message { header, data } = record
                && is_wanted(header.channel_id)
            {
                let (channel, utc_ns) = (header.channel_id, header.log_time);
                found.push(IndexedMessage { channel, utc_ns, bytes: data.into_owned() });
            }
        }
        Ok(found)
    }

    fn bytes(&self, offset: u64, length: usize) -> Result<Vec<u8>, RecordingError> {
        let mut bytes = vec![0; length];
        let read = self.file.read_exact_at(&mut bytes, offset);
        read.map_err(|error| RecordingError::File { path: self.path.clone(), error })?;
        Ok(bytes)
    }

    /// The chunk in a record. `record` includes the head.
    fn unpack(&self, offset: u64, record: &[u8]) -> Result<Chunk, RecordingError> {
        let damaged = |reason: &str| damaged(&self.path, offset, reason);
        let (head, body) =
            record.split_at_checked(RECORD_HEAD).ok_or_else(|| damaged("half a record"))?;
        match mcap::parse_record(head[0], body) {
            Ok(Record::Chunk { header, data }) => {
                Chunk::of(&header, &data, LARGEST_RECORD).map_err(|reason| damaged(&reason))
            }
            Ok(_) => Err(damaged("there is no chunk where the index has one")),
            Err(error) => Err(damaged(&error.to_string())),
        }
    }

    /// Reads the index at the end of the file. False if there is none, or if it is invalid.
    fn read_index(&mut self, bytes: u64) -> bool {
        let Some(summary) = self.summary(bytes) else { return false };
        let of_channel = |channel: &Arc<mcap::Channel<'_>>| {
            let (message, definition) =
                channel.schema.as_ref().map_or_else(Default::default, |schema| {
                    (schema.name.clone(), String::from_utf8_lossy(&schema.data).into_owned())
                });
            Arc::new(ChannelKind { topic: channel.topic.clone(), message, definition })
        };
        self.channels =
            summary.channels.iter().map(|(id, channel)| (*id, of_channel(channel))).collect();
        let place = |index: &mcap::records::ChunkIndex| ChunkPlace {
            offset: index.chunk_start_offset,
            length: index.chunk_length,
            first_ns: index.message_start_time,
            last_ns: index.message_end_time,
            channels: index.message_index_offsets.keys().copied().collect(),
        };
        self.chunks = summary.chunk_indexes.iter().map(place).collect();
        self.chunks.sort_by_key(|chunk| chunk.offset);
        self.ending = Ending::Whole;
        let fits = |chunk: &ChunkPlace| {
            let end = chunk.offset.checked_add(chunk.length);
            let is_inside = end.is_some_and(|end| end <= bytes);
            is_inside && chunk.first_ns <= chunk.last_ns && !chunk.channels.is_empty()
        };
        let is_in_order = self.chunks.windows(2).all(|pair| pair[0].first_ns <= pair[1].first_ns);
        let counted = summary.stats.as_ref().map_or(0, |stats| stats.message_count);
        self.chunks.iter().all(fits) && is_in_order && (counted == 0) == self.chunks.is_empty()
    }

    fn summary(&self, bytes: u64) -> Option<Summary> {
        let options = SummaryReaderOptions::default()
            .with_file_size(bytes)
            .with_record_length_limit(LARGEST_RECORD);
        let mut reader = SummaryReader::new_with_options(options);
        let mut place = 0;
        while let Some(event) = reader.next_event() {
            match event.ok()? {
                SummaryReadEvent::SeekRequest(to) => {
                    place = match to {
                        std::io::SeekFrom::Start(at) => at,
                        std::io::SeekFrom::End(back) => bytes.checked_add_signed(back)?,
                        std::io::SeekFrom::Current(on) => place.checked_add_signed(on)?,
                    };
                    reader.notify_seeked(place);
                }
                SummaryReadEvent::ReadRequest(wanted) => {
                    let read = self.file.read_at(reader.insert(wanted), place).ok()?;
                    reader.notify_read(read);
                    place += read as u64;
                }
            }
        }
        reader.finish()
    }

    /// Makes the index of a file without one, up to the end of the file or to the damage.
    fn make_index(&mut self, bytes: u64) -> Result<(), RecordingError> {
        let mut offset = mcap::MAGIC.len() as u64;
        let mut schemas = BTreeMap::new();
        // An incomplete record at the end was being written when the recorder was killed.
        while offset + RECORD_HEAD as u64 <= bytes {
            let head = self.bytes(offset, RECORD_HEAD)?;
            let mut length = [0; 8];
            length.copy_from_slice(&head[1..]);
            let length = u64::from_le_bytes(length);
            let end = offset.saturating_add(RECORD_HEAD as u64).saturating_add(length);
            match head[0] {
                0 => return Err(damaged(&self.path, offset, "zeros where a record should be")),
                op::DATA_END | op::FOOTER => {
                    self.ending = Ending::Whole;
                    return Ok(());
                }
                _ if length > LARGEST_RECORD as u64 => {
                    let reason = McapError::RecordTooLarge { opcode: head[0], len: length };
                    return Err(damaged(&self.path, offset, &reason.to_string()));
                }
                _ if end > bytes => return Ok(()),
                op::CHUNK => self.note_chunk(offset, end - offset, &mut schemas)?,
                op::MESSAGE => {
                    let reason =
                        "a message outside of chunks, which `flockeye record` does not write";
                    return Err(damaged(&self.path, offset, reason));
                }
                _ => {}
            }
            offset = end;
        }
        Ok(())
    }

    /// Adds a chunk to the index.
    fn note_chunk(
        &mut self,
        offset: u64,
        length: u64,
        schemas: &mut BTreeMap<u16, (String, String)>,
    ) -> Result<(), RecordingError> {
        // The caller has checked that the length is at most the largest record.
        let record = self.bytes(offset, length as usize)?;
        let mut chunk = self.unpack(offset, &record)?;
        let mut place =
            ChunkPlace { offset, length, first_ns: u64::MAX, last_ns: 0, channels: Vec::new() };
        let damaged = |reason: &str| damaged(&self.path, offset, reason);
        while let Some(record) = chunk.next_borrowed().map_err(|reason| damaged(&reason))? {
            match record {
                Record::Schema { header, data } => {
                    let definition = String::from_utf8_lossy(&data).into_owned();
                    schemas.insert(header.id, (header.name, definition));
                }
                Record::Channel(channel) => {
                    let known = schemas.get(&channel.schema_id).cloned();
                    let (message, definition) = known.unwrap_or_default();
                    let kind = ChannelKind { topic: channel.topic, message, definition };
                    self.channels.insert(channel.id, Arc::new(kind));
                }
                Record::Message { header, .. } => {
                    place.first_ns = place.first_ns.min(header.log_time);
                    place.last_ns = place.last_ns.max(header.log_time);
                    if !place.channels.contains(&header.channel_id) {
                        place.channels.push(header.channel_id);
                    }
                }
                _ => {}
            }
        }
        if !place.channels.is_empty() {
            self.chunks.push(place);
        }
        Ok(())
    }
}
