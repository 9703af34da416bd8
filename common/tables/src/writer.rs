//! A writer of CSV files.

use std::fs::File;
use std::marker::PhantomData;
use std::path::{Path, PathBuf};

use anyhow::Context;
use serde::Serialize;

/// A row that can be written.
pub trait WrittenRow: Serialize {
    /// The names of the columns, in the order of serialization.
    fn names() -> Vec<&'static str>;
}

/// A CSV file of rows `R` that is being written. Its first line contains the column names.
pub struct TableWriter<R> {
    path: PathBuf,
    writer: csv::Writer<File>,
    row: PhantomData<fn(R)>,
}

impl<R: WrittenRow> TableWriter<R> {
    /// Creates the file.
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
    /// The row cannot be written, for example because the disk is full.
    pub fn add(&mut self, row: &R) -> anyhow::Result<()> {
        self.writer.serialize(row).with_context(|| format!("cannot write {}", self.path.display()))
    }

    /// Writes what is still in memory to the file.
    pub fn finish(mut self) -> anyhow::Result<()> {
        self.writer.flush().with_context(|| format!("cannot write {}", self.path.display()))
    }
}
