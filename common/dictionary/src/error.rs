//! Errors of dictionaries.

use crate::names::PREDEFINED;

/// Reason why a dictionary cannot be loaded, or does not fit the bodies.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say what the fields are")]
pub enum DictionaryError {
    /// The name is neither known nor a file.
    #[error(
        "unknown dictionary '{name}'. Known are {}; a path to a dictionary file in OpenCV's YAML \
         form is another way (is there such a file?)",
        PREDEFINED.join(", ")
    )]
    Unknown { name: String },
    /// The file is no dictionary.
    #[error("'{path}' is no dictionary file: {what}")]
    File { path: String, what: String },
    /// Bodies with markers that the dictionary does not have; every such body is named.
    #[error(
        "{}; {name} has ids 0 to {last}. Cure: choose other ids, or a larger dictionary",
        .outside.join("; ")
    )]
    Outside { name: String, last: usize, outside: Vec<String> },
    /// OpenCV refused.
    #[error("OpenCV: {0}")]
    OpenCv(#[from] opencv::Error),
}
