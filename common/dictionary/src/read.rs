//! Dictionary files.

use opencv::aruco::Dictionary as CvDictionary;
use opencv::core::{FileStorage, FileStorage_READ, Mat, Ptr};
use opencv::prelude::*;

use crate::DictionaryError;

/// Maximum width of a marker without border, cells.
const MAX_BITS: i32 = 16;
/// Maximum number of markers.
const MAX_MARKERS: i32 = 100_000;
/// Maximum size of a file, bytes. The largest dictionary of 16 x 16 cells takes a third of it.
const MAX_BYTES: u64 = 100_000_000;

pub(crate) fn refused(path: &str, what: &str) -> DictionaryError {
    DictionaryError::File { path: path.to_owned(), what: what.to_owned() }
}

/// Reads a file. OpenCV's own reader writes past its buffer when a row of bits is too long, so each
/// row is checked here.
pub(crate) fn file(path: &str) -> Result<Ptr<CvDictionary>, DictionaryError> {
    let bytes = std::fs::metadata(path).map_or(0, |metadata| metadata.len());
    if bytes > MAX_BYTES {
        let what = format!("it has {bytes} bytes, and at most {MAX_BYTES} are read");
        return Err(refused(path, &what));
    }
    let file = FileStorage::new_def(path, FileStorage_READ)
        .map_err(|error| refused(path, &error.message))?;
    if !file.is_opened()? {
        return Err(refused(path, "it cannot be opened"));
    }
    let number = |key: &str| -> Result<Option<i32>, DictionaryError> {
        let node = file.get_node(key)?;
        Ok(if node.is_int()? { Some(node.to_i32()?) } else { None })
    };
    let in_range = |key: &str, max: i32| {
        let value = number(key)?.filter(|value| (1..=max).contains(value));
        value.ok_or_else(|| refused(path, &format!("{key} must be a whole number from 1 to {max}")))
    };
    let count = in_range("nmarkers", MAX_MARKERS)?;
    let size = in_range("markersize", MAX_BITS)?;
    let correctable = number("maxCorrectionBits")?.unwrap_or(0);
    let mut markers = Vec::new();
    for id in 0..count {
        let node = file.get_node(&format!("marker_{id}"))?;
        let text = if node.is_string()? { node.to_string()? } else { String::new() };
        let bits: Vec<u8> = text.bytes().map(|bit| bit.wrapping_sub(b'0')).collect();
        if bits.len() != (size * size) as usize || bits.iter().any(|&bit| bit > 1) {
            let what = format!("marker_{id} must be a text of {} digits 0 and 1", size * size);
            return Err(refused(path, &what));
        }
        markers.push(bits);
    }
    Ok(of_bits(markers, size, correctable)?)
}

/// The dictionary of these markers: their cells row by row, 1 for white.
pub(crate) fn of_bits(
    markers: impl IntoIterator<Item = Vec<u8>>,
    size: i32,
    correctable: i32,
) -> opencv::Result<Ptr<CvDictionary>> {
    let mut list = Mat::default();
    for bits in markers {
        let bits = Mat::new_rows_cols_with_data(size, size, &bits)?;
        list.push_back(&CvDictionary::get_byte_list_from_bits(&bits)?)?;
    }
    Ok(Ptr::new(CvDictionary::new(&list, size, correctable)?))
}
