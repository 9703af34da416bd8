//! What can be wrong with a dictionary.

use crate::names::PREDEFINED;

/// Why a dictionary could not be had, or does not fit the bodies.
#[derive(Debug, thiserror::Error)]
pub enum DictionaryError {
    /// Neither a known name nor a file.
    #[error(
        "unknown dictionary '{name}'. Known are {}; a path to a dictionary file in OpenCV's YAML \
         form is another way (is there such a file?)",
        PREDEFINED.join(", ")
    )]
    Unknown {
        /// What was asked for.
        name: String,
    },
    /// A file that is no dictionary.
    #[error("'{path}' is no dictionary file: {what}")]
    File {
        /// The file.
        path: String,
        /// What is wrong in it.
        what: String,
    },
    /// Bodies with markers that the dictionary does not have: every such body is named.
    #[error(
        "{}; {name} has ids 0 to {last}. Cure: choose other ids, or a larger dictionary",
        .outside.join("; ")
    )]
    Outside {
        /// The dictionary.
        name: String,
        /// Its last id.
        last: usize,
        /// For each body that is wrong: which of its ids.
        outside: Vec<String>,
    },
    /// OpenCV refused.
    #[error("OpenCV: {0}")]
    OpenCv(#[from] opencv::Error),
}
