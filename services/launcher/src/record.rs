//! Poses and truth as CSV.

mod pose;
mod table;
mod truth;

use std::fs::File;
use std::path::{Path, PathBuf};

use anyhow::Context;
use serde::Serialize;

pub use pose::{MeasuredPose, PoseRow};
pub use table::{Cells, Row, TableError, read};
pub use truth::TruthRow;

/// A CSV file that is being written.
pub struct Recorder {
    path: PathBuf,
    writer: csv::Writer<File>,
}

impl Recorder {
    /// Creates the file.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn create(path: &Path) -> anyhow::Result<Self> {
        let writer = csv::Writer::from_path(path)
            .with_context(|| format!("cannot write {}", path.display()))?;
        Ok(Self { path: path.to_owned(), writer })
    }

    /// Adds a row.
    ///
    /// # Errors
    /// It cannot be written: a full disk, say.
    pub fn add(&mut self, row: impl Serialize) -> anyhow::Result<()> {
        self.writer.serialize(row).with_context(|| format!("cannot write {}", self.path.display()))
    }

    /// Brings everything to the file.
    ///
    /// # Errors
    /// As [`Recorder::add`].
    pub fn finish(mut self) -> anyhow::Result<()> {
        self.writer.flush().with_context(|| format!("cannot write {}", self.path.display()))
    }
}
