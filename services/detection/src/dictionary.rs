//! Dictionaries: which cells belong to which id.

use std::path::Path;

use flockeye_imaging::edges::MarkerPrint;
use opencv::aruco::{self, Dictionary as CvDictionary};
use opencv::core::{FileStorage, FileStorage_READ, Mat, Ptr};
use opencv::prelude::*;

use crate::DetectError;

/// OpenCV 4.6's predefined dictionaries, in the order of its own enumeration.
pub const PREDEFINED: [&str; 21] = [
    "DICT_4X4_50",
    "DICT_4X4_100",
    "DICT_4X4_250",
    "DICT_4X4_1000",
    "DICT_5X5_50",
    "DICT_5X5_100",
    "DICT_5X5_250",
    "DICT_5X5_1000",
    "DICT_6X6_50",
    "DICT_6X6_100",
    "DICT_6X6_250",
    "DICT_6X6_1000",
    "DICT_7X7_50",
    "DICT_7X7_100",
    "DICT_7X7_250",
    "DICT_7X7_1000",
    "DICT_ARUCO_ORIGINAL",
    "DICT_APRILTAG_16h5",
    "DICT_APRILTAG_25h9",
    "DICT_APRILTAG_36h10",
    "DICT_APRILTAG_36h11",
];

/// Markers wider than this many cells (without border) are no dictionary of anybody's.
const MAX_BITS: i32 = 16;
/// Nor are more of them.
const MAX_MARKERS: i32 = 100_000;

/// A set of markers, by id from 0.
pub struct Dictionary {
    pub(crate) prints: Vec<MarkerPrint>,
    pub(crate) bits: usize,
}

impl Dictionary {
    /// One of [`PREDEFINED`], by name, or the dictionary in a file of OpenCV's own form (YAML or
    /// XML with `nmarkers`, `markersize`, `maxCorrectionBits` and `marker_0` to `marker_<n-1>`),
    /// by path.
    ///
    /// # Errors
    /// A name that is neither, a file that is no dictionary (with what is wrong in it), or what
    /// OpenCV says.
    pub fn load(name: &str) -> Result<Self, DetectError> {
        let opencv = match PREDEFINED.iter().position(|&known| known == name) {
            // The enumeration counts from 0 without gaps.
            Some(index) => aruco::get_predefined_dictionary_i32(index as i32)?,
            None if Path::new(name).is_file() => read(name)?,
            None => return Err(DetectError::UnknownDictionary { name: name.to_owned() }),
        };
        let size = opencv.marker_size();
        let list = opencv.bytes_list();
        let mut prints = Vec::with_capacity(list.rows() as usize);
        for id in 0..list.rows() {
            let bits = CvDictionary::get_bits_from_byte_list(&list.row(id)?, size)?;
            let white: Vec<bool> = bits.data_bytes()?.iter().map(|&bit| bit != 0).collect();
            prints.push(MarkerPrint::of_bits(&white).ok_or_else(|| refused(name, "cells"))?);
        }
        Ok(Self { prints, bits: size as usize })
    }

    /// How many markers it has: ids are 0 to one less.
    pub fn marker_count(&self) -> usize {
        self.prints.len()
    }

    /// What marker `id` looks like.
    pub fn print(&self, id: u32) -> Option<&MarkerPrint> {
        self.prints.get(id as usize)
    }
}

fn refused(path: &str, what: &str) -> DetectError {
    DetectError::DictionaryFile { path: path.to_owned(), what: what.to_owned() }
}

/// Reads a file. OpenCV's own reader writes past its buffer when a row of bits is too long, so each
/// is checked here.
fn read(path: &str) -> Result<Ptr<CvDictionary>, DetectError> {
    let file = FileStorage::new_def(path, FileStorage_READ)
        .map_err(|error| refused(path, &error.message))?;
    if !file.is_opened()? {
        return Err(refused(path, "it cannot be opened"));
    }
    let number = |key: &str| -> Result<Option<i32>, DetectError> {
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
    let mut list = Mat::default();
    for id in 0..count {
        let node = file.get_node(&format!("marker_{id}"))?;
        let text = if node.is_string()? { node.to_string()? } else { String::new() };
        let bits: Vec<u8> = text.bytes().map(|bit| bit.wrapping_sub(b'0')).collect();
        if bits.len() != (size * size) as usize || bits.iter().any(|&bit| bit > 1) {
            let what = format!("marker_{id} must be a text of {} digits 0 and 1", size * size);
            return Err(refused(path, &what));
        }
        let bits = Mat::new_rows_cols_with_data(size, size, &bits)?;
        list.push_back(&CvDictionary::get_byte_list_from_bits(&bits)?)?;
    }
    Ok(Ptr::new(CvDictionary::new(&list, size, correctable)?))
}
