//! Problems of a configuration, with their places.

use std::fmt;
use std::path::PathBuf;

/// Place of a value, for messages.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Origin {
    /// A place in the file: line and column from 1.
    File {
        /// Line.
        line: usize,
        /// Column.
        column: usize,
    },
    /// An override on the command line, `key=value`.
    Override(String),
}

impl fmt::Display for Origin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::File { line, column } => write!(f, "line {line}, column {column}"),
            Self::Override(text) => write!(f, "--set {text}"),
        }
    }
}

/// One problem of a configuration.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Problem {
    /// Place of the value.
    pub origin: Origin,
    /// Dotted path of the value; empty for the document as a whole.
    pub path: String,
    /// The fault, and the allowed values.
    pub what: String,
}

impl Problem {
    pub(crate) fn new(origin: Origin, path: &str, what: String) -> Self {
        Self { origin, path: path.to_owned(), what }
    }
}

impl fmt::Display for Problem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let separator = if self.path.is_empty() { "" } else { ": " };
        write!(f, "{}: {}{separator}{}", self.origin, self.path, self.what)
    }
}

/// Reason of a refused configuration.
#[expect(missing_docs, reason = "the texts name the fields")]
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read {path}: {error}")]
    Read { path: PathBuf, error: std::io::Error },
    /// The document has problems in these places.
    #[error("{name} has {}:\n{}", count(.problems), list(.problems))]
    Problems { name: String, problems: Vec<Problem> },
}

fn count(problems: &[Problem]) -> String {
    match problems.len() {
        1 => "a problem".to_owned(),
        several => format!("{several} problems"),
    }
}

fn list(problems: &[Problem]) -> String {
    problems.iter().map(|problem| format!("  {problem}")).collect::<Vec<_>>().join("\n")
}
