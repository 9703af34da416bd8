//! Dictionaries: the cells of each marker id.
//!
//! OpenCV has 22 of its own, by name; others are files in OpenCV's format. Every stage that detects
//! markers uses this one reader.
//!
//! ```
//! use flockeye_dictionary::Dictionary;
//! use flockeye_geometry::body::{Bodies, squares};
//!
//! let bodies = Bodies::new("DICT_5X5_250".into(), vec![squares("alpha", 0.0625, 0.05, 0)])?;
//! let dictionary = Dictionary::of(&bodies)?;
//! assert_eq!((dictionary.bits(), dictionary.marker_count()), (5, 250));
//! assert!(dictionary.print(16).is_some());
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod error;
mod mip_36h12;
mod names;
mod predefined;
mod read;

use std::path::Path;

use flockeye_geometry::body::Bodies;
use flockeye_imaging::edges::MarkerPrint;
use opencv::aruco::Dictionary as CvDictionary;
use opencv::core::Ptr;
use opencv::prelude::*;

pub use crate::error::DictionaryError;
pub use crate::names::PREDEFINED;

/// A set of markers, by id from 0.
pub struct Dictionary {
    name: String,
    opencv: Ptr<CvDictionary>,
    prints: Vec<MarkerPrint>,
    bits: usize,
}

impl std::fmt::Debug for Dictionary {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} ({} markers of {} bits)", self.name, self.marker_count(), self.bits)
    }
}

impl Dictionary {
    /// A dictionary: one of [`PREDEFINED`], by name, or a file in OpenCV's format, by path. The
    /// file is YAML or XML with `nmarkers`, `markersize`, `maxCorrectionBits` and `marker_0` to
    /// `marker_<n-1>`.
    ///
    /// # Errors
    /// The name is neither, the file is no dictionary (with the fault), or OpenCV fails.
    pub fn load(name: &str) -> Result<Self, DictionaryError> {
        let (name, opencv) = match predefined::predefined(name)? {
            Some(predefined) => predefined,
            None if Path::new(name).is_file() => (name, read::file(name)?),
            None => return Err(DictionaryError::Unknown { name: name.to_owned() }),
        };
        let size = opencv.marker_size();
        let list = opencv.bytes_list();
        let mut prints = Vec::with_capacity(list.rows() as usize);
        for id in 0..list.rows() {
            let bits = CvDictionary::get_bits_from_byte_list(&list.row(id)?, size)?;
            let white: Vec<bool> = bits.data_bytes()?.iter().map(|&bit| bit != 0).collect();
            prints
                .push(MarkerPrint::of_bits(&white).ok_or_else(|| {
                    read::refused(name, "its markers have less than 2 x 2 cells")
                })?);
        }
        Ok(Self { name: name.to_owned(), opencv, prints, bits: size as usize })
    }

    /// The dictionary of `bodies`, which has all of their markers.
    ///
    /// # Errors
    /// As [`Dictionary::load`]; and ids that it does not have ([`DictionaryError::Outside`]).
    pub fn of(bodies: &Bodies) -> Result<Self, DictionaryError> {
        let dictionary = Self::load(&bodies.dictionary)?;
        dictionary.check(bodies)?;
        Ok(dictionary)
    }

    /// Checks that the dictionary has every marker of `bodies`.
    ///
    /// # Errors
    /// [`DictionaryError::Outside`]: each body with ids that it does not have.
    pub fn check(&self, bodies: &Bodies) -> Result<(), DictionaryError> {
        let outside = bodies.iter().filter_map(|body| {
            let ids: Vec<String> = body
                .markers
                .iter()
                .filter(|marker| self.print(marker.id).is_none())
                .map(|marker| marker.id.to_string())
                .collect();
            let plural = if ids.len() == 1 { "" } else { "s" };
            (!ids.is_empty())
                .then(|| format!("body '{}' has marker{plural} {}", body.name, ids.join(", ")))
        });
        let outside: Vec<String> = outside.collect();
        if outside.is_empty() {
            return Ok(());
        }
        let last = self.marker_count().saturating_sub(1);
        Err(DictionaryError::Outside { name: self.name.clone(), last, outside })
    }

    /// The name or the path by which it was loaded.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Cells along a side of a marker without its border: 5 for `DICT_5X5_250`.
    pub fn bits(&self) -> usize {
        self.bits
    }

    /// Number of its markers: ids are 0 to one less.
    pub fn marker_count(&self) -> usize {
        self.prints.len()
    }

    /// Printed pattern of marker `id`.
    pub fn print(&self, id: u32) -> Option<&MarkerPrint> {
        self.prints.get(id as usize)
    }

    /// Printed patterns of the markers, by id.
    pub fn prints(&self) -> &[MarkerPrint] {
        &self.prints
    }

    /// The dictionary as an object of OpenCV.
    pub fn opencv(&self) -> &Ptr<CvDictionary> {
        &self.opencv
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use flockeye_geometry::body::squares;

    use super::*;

    #[test]
    fn marker_zero_is_the_published_one() {
        let dictionary = Dictionary::load("DICT_5X5_250").unwrap();
        let print = dictionary.print(0).unwrap();
        let rows = (1..=5).map(|row| {
            (1..=5).map(|column| if print.is_white(row, column) { '#' } else { '.' }).collect()
        });
        let rows: Vec<String> = rows.collect();
        assert_eq!(rows, ["#.#..", ".#.##", ".##..", "#.#.#", "###.."]);
        assert!(dictionary.print(250).is_none());
    }

    /// Among the published properties: 250 markers of 6 x 6 cells, of which any two differ in at
    /// least 12 cells, however they are turned.
    #[test]
    fn the_dictionary_that_debian_lacks_is_the_published_one() {
        let dictionary = Dictionary::load("dict_aruco_mip_36H12").unwrap();
        assert_eq!(dictionary.name(), "DICT_ARUCO_MIP_36h12");
        assert_eq!((dictionary.bits(), dictionary.marker_count()), (6, 250));
        let white = |id: u32, turn: u32, row: isize, column: isize| {
            let (mut row, mut column) = (row, column);
            (0..turn).for_each(|_| (row, column) = (column, 5 - row));
            dictionary.print(id).unwrap().is_white(row + 1, column + 1)
        };
        let differ = |one: u32, other: u32, turn: u32| {
            let cells = (0..36).map(|cell| (cell / 6, cell % 6));
            cells.filter(|(r, c)| white(one, 0, *r, *c) != white(other, turn, *r, *c)).count()
        };
        for one in 0..250 {
            for (other, turn) in (0..=one).flat_map(|other| (0..4).map(move |turn| (other, turn))) {
                let cells = differ(one, other, turn);
                assert!(cells >= 12 || (one, 0) == (other, turn), "{one} {other} {turn}: {cells}");
            }
        }
    }

    #[test]
    fn bodies_beyond_the_dictionary_are_all_named() {
        let bodies = vec![squares("a", 0.06, 0.05, 33), squares("b", 0.06, 0.05, 50)];
        let bodies = Bodies::new("DICT_4X4_50".into(), bodies).unwrap();
        let error = Dictionary::of(&bodies).expect_err("17 ids too many").to_string();
        assert!(error.starts_with("body 'b' has markers 50, 51, "), "{error}");
        assert!(error.contains("66; DICT_4X4_50 has ids 0 to 49"), "{error}");
        let bodies = Bodies::new("DICT_5X5_50".into(), vec![squares("a", 0.06, 0.05, 34)]).unwrap();
        let error = Dictionary::of(&bodies).expect_err("one id too many").to_string();
        assert!(error.starts_with("body 'a' has marker 50; DICT_5X5_50"), "{error}");
    }
}
