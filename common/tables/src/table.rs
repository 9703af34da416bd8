//! CSV files read by the names of their columns.

use std::collections::BTreeMap;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use csv::StringRecord;
use nalgebra::{Quaternion, SMatrix, UnitQuaternion};
use serde::Serialize;

/// The reason why a table cannot be read.
#[allow(missing_docs, reason = "the messages say what each is")]
#[derive(Debug, thiserror::Error)]
pub enum TableError {
    #[error("cannot read {path}: {reason}")]
    Unreadable { path: PathBuf, reason: String },
    #[error(
        "{path} has no column {}. Cure: {cure}; the first line names the columns, and here it is \
         '{header}'",
        .missing.join(", ")
    )]
    Columns { path: PathBuf, missing: Vec<&'static str>, cure: &'static str, header: String },
    #[error(
        "{path}, line {line}, column {column}: '{text}' is not {wanted}. Cure: correct it, or remove the line"
    )]
    Cell { path: PathBuf, line: u64, column: String, text: String, wanted: &'static str },
}

/// A row of a table.
pub trait TableRow: Sized {
    /// Required columns, in the form of a file's first line.
    const REQUIRED: &'static str;
    /// The remedy if a column is missing: how to get a file with these columns.
    const CURE: &'static str;

    /// Reads a row from its cells.
    fn parse(cells: &TableCells<'_>) -> Result<Self, TableError>;
}

/// The cells of a line, by the names of their columns.
pub struct TableCells<'a> {
    path: &'a Path,
    columns: &'a BTreeMap<String, usize>,
    record: &'a StringRecord,
    line: u64,
}

impl TableCells<'_> {
    /// The text of a cell; empty if there is no such column.
    pub fn text(&self, column: &str) -> &str {
        self.columns.get(column).and_then(|&index| self.record.get(index)).unwrap_or("").trim()
    }

    /// The value of a cell; `None` if it is empty. `wanted` describes a valid value in the error.
    pub fn value<T: FromStr>(
        &self,
        column: &str,
        wanted: &'static str,
    ) -> Result<Option<T>, TableError> {
        let text = self.text(column);
        if text.is_empty() {
            return Ok(None);
        }
        text.parse().map(Some).map_err(|_| self.refuse(column, wanted))
    }

    /// A number; `None` in an empty cell.
    pub fn maybe_number(&self, column: &str) -> Result<Option<f64>, TableError> {
        let wanted = "a finite number";
        match self.value::<f64>(column, wanted)? {
            Some(number) if !number.is_finite() => Err(self.refuse(column, wanted)),
            number => Ok(number),
        }
    }

    /// A required number.
    pub fn number(&self, column: &str) -> Result<f64, TableError> {
        self.maybe_number(column)?.ok_or_else(|| self.refuse(column, "a finite number"))
    }

    /// A required whole number, 0 or more.
    pub fn count(&self, column: &str) -> Result<u64, TableError> {
        let wanted = "a whole number from 0";
        self.value(column, wanted)?.ok_or_else(|| self.refuse(column, wanted))
    }

    /// A required whole number, 0 or more, of 32 bits.
    pub fn small_count(&self, column: &str) -> Result<u32, TableError> {
        u32::try_from(self.count(column)?)
            .map_err(|_| self.refuse(column, "a whole number below 4294967296"))
    }

    /// A rotation from the columns of its quaternion x, y, z, w.
    ///
    /// # Errors
    /// A cell is not a number, or the quaternion's length is not 1 within 1 %.
    pub fn rotation(&self, xyzw: [&str; 4]) -> Result<UnitQuaternion<f64>, TableError> {
        let [x, y, z, w] = xyzw;
        let quaternion =
            Quaternion::new(self.number(w)?, self.number(x)?, self.number(y)?, self.number(z)?);
        if (quaternion.norm() - 1.0).abs() > 0.01 {
            return Err(self.refuse(w, "the w of a quaternion of length 1"));
        }
        Ok(UnitQuaternion::from_quaternion(quaternion))
    }

    /// A symmetric matrix from the columns of its upper triangle, row by row.
    pub fn symmetric<const SIZE: usize>(
        &self,
        columns: &[&str],
    ) -> Result<SMatrix<f64, SIZE, SIZE>, TableError> {
        let mut matrix = SMatrix::zeros();
        for (name, (row, column)) in columns.iter().zip(upper_triangle(SIZE)) {
            let number = self.number(name)?;
            matrix[(row, column)] = number;
            matrix[(column, row)] = number;
        }
        Ok(matrix)
    }

    /// The code with the name in a cell.
    pub fn code<T: Copy + Serialize>(
        &self,
        codes: &[T],
        column: &str,
        wanted: &'static str,
    ) -> Result<T, TableError> {
        let text = self.text(column);
        let named = codes.iter().find(|code| name(code) == text);
        named.copied().ok_or_else(|| self.refuse(column, wanted))
    }

    /// The error of an invalid cell.
    pub fn refuse(&self, column: &str, wanted: &'static str) -> TableError {
        TableError::Cell {
            path: self.path.to_owned(),
            line: self.line,
            column: column.to_owned(),
            text: self.text(column).to_owned(),
            wanted,
        }
    }
}

/// Row and column numbers of the upper triangle of a square matrix, row by row.
fn upper_triangle(size: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..size).flat_map(move |row| (row..size).map(move |column| (row, column)))
}

/// The upper triangle of a square matrix, row by row.
pub(crate) fn triangle<const SIZE: usize, const CELLS: usize>(
    matrix: &SMatrix<f64, SIZE, SIZE>,
) -> [f64; CELLS] {
    let mut places = upper_triangle(SIZE);
    // `CELLS` is the size of the triangle, so no place is missing.
    std::array::from_fn(|_| places.next().map_or(0.0, |place| matrix[place]))
}

/// A cell for each number. All are empty if the numbers are unknown.
pub(crate) fn cells<const CELLS: usize>(numbers: Option<[f64; CELLS]>) -> [Option<f64>; CELLS] {
    std::array::from_fn(|k| numbers.map(|numbers| numbers[k]))
}

/// The name of a code in a file.
fn name(code: impl Serialize) -> String {
    match serde_json::to_value(code) {
        Ok(serde_json::Value::String(name)) => name,
        _ => String::new(),
    }
}

/// Reads a CSV file by its column names.
///
/// # Errors
/// The file cannot be read, columns are missing, or a cell is invalid. The error contains line and
/// column.
pub fn read<R: TableRow>(path: &Path) -> Result<Vec<R>, TableError> {
    let unreadable = |error: csv::Error| TableError::Unreadable {
        path: path.to_owned(),
        reason: error.to_string(),
    };
    let file = File::open(path).map_err(|error| unreadable(error.into()))?;
    let mut reader = csv::Reader::from_reader(file);
    let header = reader.headers().map_err(unreadable)?.clone();
    let columns: BTreeMap<String, usize> =
        header.iter().map(|name| name.trim().to_owned()).zip(0..).collect();
    let missing: Vec<&'static str> =
        R::REQUIRED.split(',').filter(|name| !columns.contains_key(*name)).collect();
    if !missing.is_empty() {
        return Err(TableError::Columns {
            path: path.to_owned(),
            missing,
            cure: R::CURE,
            header: header.iter().collect::<Vec<_>>().join(","),
        });
    }
    let mut rows = Vec::new();
    for record in reader.records() {
        let record = record.map_err(unreadable)?;
        let line = record.position().map_or(0, csv::Position::line);
        rows.push(R::parse(&TableCells { path, columns: &columns, record: &record, line })?);
    }
    Ok(rows)
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Point {
        x: f64,
        n: u64,
    }

    impl TableRow for Point {
        const REQUIRED: &'static str = "x,n";
        const CURE: &'static str = "write both";

        fn parse(cells: &TableCells<'_>) -> Result<Self, TableError> {
            Ok(Self { x: cells.number("x")?, n: cells.count("n")? })
        }
    }

    fn read_text(name: &str, text: &str) -> Result<Vec<Point>, String> {
        let path = std::env::temp_dir().join(format!("flockeye-{}-{name}.csv", std::process::id()));
        std::fs::write(&path, text).expect("it can be written");
        let rows = read(&path).map_err(|error| error.to_string());
        std::fs::remove_file(&path).expect("it can be removed");
        rows
    }

    #[test]
    fn columns_are_found_by_name() {
        let rows = read_text("order", "n, more ,x\n3,,1.5\n4,z, 2e-3\n").expect("a table");
        assert_eq!(
            rows.iter().map(|row| (row.x, row.n)).collect::<Vec<_>>(),
            [(1.5, 3), (2e-3, 4)]
        );
    }

    #[test]
    fn errors_name_the_place_and_the_cure() {
        for (name, text, wanted) in [
            ("missing", "a,b\n1,2\n", &["has no column x, n. Cure: write both", "'a,b'"][..]),
            ("empty", "", &["has no column x, n"]),
            ("word", "x,n\n1,2\nten,3\n", &["line 3, column x: 'ten' is not a finite number"]),
            ("nan", "x,n\nNaN,2\n", &["line 2, column x: 'NaN' is not a finite"]),
            ("hole", "x,n\n1,\n", &["line 2, column n: '' is not a whole number"]),
            ("minus", "x,n\n1,-2\n", &["'-2' is not a whole number from 0", "Cure: "]),
            ("short", "x,n\n1\n", &["cannot read ", "line: 2"]),
        ] {
            let error = read_text(name, text).err().expect("it is wrong");
            assert!(wanted.iter().all(|part| error.contains(part)), "{name}: {error}");
        }
        let error = read::<Point>(Path::new("/nowhere/x.csv")).err().expect("it is not there");
        assert!(error.to_string().starts_with("cannot read /nowhere/x.csv: "), "{error}");
    }
}
