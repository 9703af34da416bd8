//! Checks of a file before GStreamer gets it.
//!
//! Decoders give no error for these two kinds of damage.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::Path;

use crate::CaptureError;

/// Refuses missing, unreadable and truncated files.
pub(crate) fn check(path: &Path) -> Result<(), CaptureError> {
    let unreadable = |reason: String| CaptureError::Unreadable { path: path.to_owned(), reason };
    if path.is_dir() {
        return Err(unreadable("it is a folder".to_owned()));
    }
    let mut file = File::open(path).map_err(|error| match error.kind() {
        io::ErrorKind::NotFound => CaptureError::Missing {
            path: path.to_owned(),
            from: std::env::current_dir().unwrap_or_default(),
        },
        _ => unreadable(error.to_string()),
    })?;
    let mut head = [0; 8];
    if file.read_exact(&mut head).is_err() {
        // The file is too short for both checks; GStreamer reports the error.
        return Ok(());
    }
    let broken = |error: io::Error| unreadable(error.to_string());
    if &head[4..] == b"ftyp" && !has_index(&mut file).map_err(broken)? {
        return Err(CaptureError::NotAVideo {
            path: path.to_owned(),
            reason: "its index (the moov box) is missing: the recording was cut short before it was finished. \
                     Cure: record to Matroska (.mkv), which plays up to where it was cut"
                .to_owned(),
        });
    }
    if head[..2] == [0xFF, 0xD8] && !has_jpeg_end(&mut file).map_err(broken)? {
        return Err(unreadable("it was cut short: its end marker is missing".to_owned()));
    }
    Ok(())
}

/// Whether an MP4 file has a top-level `moov` box (ISO/IEC 14496-12, section 4.2). Each box begins
/// with length and type. Length 1: a length of 8 bytes follows; length 0: last box.
///
/// GStreamer's demuxer reports this too, but its bin may drop the report and wait for ever.
fn has_index(file: &mut (impl Read + Seek)) -> io::Result<bool> {
    let number = |bytes: &[u8]| bytes.iter().fold(0_u64, |sum, &byte| sum << 8 | u64::from(byte));
    let end = file.seek(SeekFrom::End(0))?;
    let mut at = 0_u64;
    while at.saturating_add(16) <= end {
        file.seek(SeekFrom::Start(at))?;
        let mut head = [0; 16];
        file.read_exact(&mut head)?;
        if &head[4..8] == b"moov" {
            return Ok(true);
        }
        let length = match number(&head[..4]) {
            0 => break,
            1 => number(&head[8..]),
            length => length,
        };
        at = at.saturating_add(length.max(8));
    }
    Ok(false)
}

/// Whether a JPEG has its end marker (FF D9, ITU-T T.81, B.1.1.3) near its end; some cameras write
/// something behind it. Decoders fill missing data with gray.
fn has_jpeg_end(file: &mut (impl Read + Seek)) -> io::Result<bool> {
    const TAIL: u64 = 64 * 1024;
    let end = file.seek(SeekFrom::End(0))?;
    file.seek(SeekFrom::Start(end.saturating_sub(TAIL)))?;
    let mut tail = Vec::new();
    file.read_to_end(&mut tail)?;
    Ok(tail.windows(2).any(|pair| pair == [0xFF, 0xD9]))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use std::io::Cursor;

    fn boxed(kind: &[u8; 4], length: u32, body: usize) -> Vec<u8> {
        [&length.to_be_bytes()[..], kind, &vec![0; body]].concat()
    }

    #[test]
    fn an_index_is_found_behind_boxes_of_either_length() {
        let file_type = boxed(b"ftyp", 16, 8);
        let long = [&1_u32.to_be_bytes()[..], b"mdat", &40_u64.to_be_bytes(), &[0; 24]].concat();
        let index = boxed(b"moov", 24, 16);
        let found = |parts: &[&Vec<u8>]| {
            has_index(&mut Cursor::new(
                parts.iter().flat_map(|part| part.iter().copied()).collect::<Vec<u8>>(),
            ))
            .unwrap()
        };
        assert!(found(&[&file_type, &long, &index]));
        assert!(found(&[&file_type, &index, &long]));
        assert!(!found(&[&file_type, &long]));
        assert!(
            !found(&[&file_type, &boxed(b"mdat", 0, 40), &index]),
            "a last box swallows what follows"
        );
        assert!(!found(&[&file_type, &boxed(b"free", 3, 40)]), "senseless lengths must not loop");
    }
}
