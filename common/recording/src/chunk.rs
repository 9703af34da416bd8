//! The records of a chunk. Sizes and checksum are checked before a record is used.

use std::io::Read;

use mcap::records::{ChunkHeader, Record};

/// A decompressed chunk, and the position of the next record.
#[derive(Debug, Default)]
pub(crate) struct Chunk {
    records: Vec<u8>,
    place: usize,
}

/// Size of a record's head, bytes: opcode and length.
pub(crate) const RECORD_HEAD: usize = 9;

impl Chunk {
    /// Decompresses a chunk. More than `largest` bytes are an error.
    pub(crate) fn of(header: &ChunkHeader, data: &[u8], largest: usize) -> Result<Self, String> {
        let size = usize::try_from(header.uncompressed_size).unwrap_or(usize::MAX);
        if size > largest {
            return Err(format!("a chunk of {size} bytes, where {largest} are the most"));
        }
        let mut records = Vec::with_capacity(size);
        match header.compression.as_str() {
            "" => records.extend_from_slice(data),
            "zstd" => {
                let failed = |error: std::io::Error| format!("a chunk cannot be unpacked: {error}");
                let decoder = zstd::stream::read::Decoder::with_buffer(data).map_err(failed)?;
                // One byte more than stated: a chunk that is too large is detected.
                decoder.take(size as u64 + 1).read_to_end(&mut records).map_err(failed)?;
            }
            other => return Err(format!("a chunk packed by {other:?}, which is not known here")),
        }
        if records.len() != size {
            return Err(format!("a chunk has {} bytes, not {size} as it says", records.len()));
        }
        let (found, said) = (crc32fast::hash(&records), header.uncompressed_crc);
        if said != 0 && found != said {
            return Err(format!("a chunk's sum is {found:08x}, not {said:08x} as it says"));
        }
        Ok(Self { records, place: 0 })
    }

    /// The next record as a copy; `None` at the end.
    pub(crate) fn next_record(&mut self) -> Result<Option<Record<'static>>, String> {
        Ok(self.next_borrowed()?.map(Record::into_owned))
    }

    /// The next record without a copy; `None` at the end.
    pub(crate) fn next_borrowed(&mut self) -> Result<Option<Record<'_>>, String> {
        let rest = self.records.get(self.place..).unwrap_or_default();
        if rest.is_empty() {
            return Ok(None);
        }
        let Some((head, data)) = rest.split_at_checked(RECORD_HEAD) else {
            return Err("a chunk ends within a record".to_owned());
        };
        let mut length = [0; 8];
        length.copy_from_slice(&head[1..]);
        let length = usize::try_from(u64::from_le_bytes(length)).unwrap_or(usize::MAX);
        let data = data.get(..length).ok_or_else(|| "a chunk ends within a record".to_owned())?;
        self.place += RECORD_HEAD + length;
        mcap::parse_record(head[0], data).map(Some).map_err(|error| error.to_string())
    }
}
