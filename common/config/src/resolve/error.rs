//! Errors of the values computed from a configuration.

use std::path::PathBuf;

use flockeye_geometry::body::BodiesError;

/// Maximum size of a bodies file, bytes: ten times that of 32 bodies with 100 markers each.
pub(super) const MAX_FILE_BYTES: u64 = 16_000_000;

/// Reason why a configuration cannot be resolved.
#[expect(missing_docs, reason = "the texts name the fields")]
#[derive(Debug, thiserror::Error)]
pub enum ResolveError {
    /// The camera, its mask or the views of its sphere are invalid.
    #[error(transparent)]
    Setting(#[from] SettingError),
    /// A bodies file cannot be read.
    #[error("cannot read the bodies file {path}: {error}")]
    Read { path: PathBuf, error: std::io::Error },
    /// The file is larger than any of its kind.
    #[error(
        "the bodies file {path} has more than {} MB, which no bodies need. Cure: give the JSON file \
         of ids and corners",
        MAX_FILE_BYTES / 1_000_000
    )]
    Size { path: PathBuf },
    /// The file contradicts itself.
    #[error("{path}: {error}")]
    File { path: PathBuf, error: BodiesError },
    /// The entries contradict each other.
    #[error("bodies.list: {0}")]
    List(BodiesError),
    /// A name that cannot go over the network.
    #[error(
        "{path}: '{name}' cannot be a body's name: use 1 to 31 letters, digits, '-', '_' and '.'"
    )]
    Name { path: PathBuf, name: String },
    /// The file lacks the named body.
    #[error("{path} has no body '{name}'; it has {}", .has.join(", "))]
    Missing { path: PathBuf, name: String, has: Vec<String> },
    /// The file has another dictionary.
    #[error("the markers of {path} are from {found}, those of the other bodies from {wanted}")]
    Dictionary { path: PathBuf, found: String, wanted: String },
    /// The body differs from the configured one.
    #[error(
        "{path}: body '{name}' has other marker ids than the configured one. Cure: give it the same \
         ids, or another name"
    )]
    Ids { path: PathBuf, name: String },
}

/// A setting that makes a computation impossible.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{key}: {reason}")]
pub struct SettingError {
    /// Its key in the configuration.
    pub key: String,
    /// The fault, and its cure.
    pub reason: String,
}

impl SettingError {
    pub(crate) fn new(key: impl Into<String>, reason: impl ToString) -> Self {
        Self { key: key.into(), reason: reason.to_string() }
    }
}
