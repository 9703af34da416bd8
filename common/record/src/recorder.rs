//! Poses and truth as CSV.

mod pose;
mod table;
mod truth;

use std::fs::File;
use std::marker::PhantomData;
use std::path::{Path, PathBuf};

use anyhow::Context;
use serde::Serialize;

pub use pose::{MeasuredPose, PoseRow};
pub use table::{Cells, Row, TableError, read};
pub use truth::TruthRow;

/// A row that is written.
pub trait Recorded: Serialize {
    /// The names of its columns, in the order in which it is serialized.
    fn names() -> Vec<&'static str>;
}

/// A CSV file of rows `R` that is being written; without a row it has its columns' names.
pub struct Recorder<R> {
    path: PathBuf,
    writer: csv::Writer<File>,
    row: PhantomData<fn(R)>,
}

impl<R: Recorded> Recorder<R> {
    /// Creates the file.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn create(path: &Path) -> anyhow::Result<Self> {
        let create = || -> csv::Result<_> {
            let mut writer = csv::WriterBuilder::new().has_headers(false).from_path(path)?;
            writer.write_record(R::names())?;
            Ok(writer)
        };
        let writer = create().with_context(|| format!("cannot write {}", path.display()))?;
        Ok(Self { path: path.to_owned(), writer, row: PhantomData })
    }

    /// Adds a row.
    ///
    /// # Errors
    /// It cannot be written: a full disk, say.
    pub fn add(&mut self, row: &R) -> anyhow::Result<()> {
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
