//! Tables of plain text.

use std::fmt::Display;

use comfy_table::{CellAlignment, ColumnConstraint, Table, Width, presets};

/// Columns of text under their titles, without lines between them. The first columns hold words,
/// which are left-aligned; the others hold numbers, which are right-aligned.
#[derive(Debug, Clone)]
pub struct TextTable {
    table: Table,
    columns: usize,
}

impl TextTable {
    /// A table whose first `words` columns hold words.
    pub fn new(words: usize, titles: &[&str]) -> Self {
        let mut table = Table::new();
        table.load_preset(presets::NOTHING);
        table.set_header(titles);
        for (index, column) in table.column_iter_mut().enumerate() {
            // Two blanks between columns, none at the edges of the table.
            column.set_padding((if index > 0 { 2 } else { 0 }, 0));
            let is_word = index < words;
            let side = if is_word { CellAlignment::Left } else { CellAlignment::Right };
            column.set_cell_alignment(side);
        }
        Self { table, columns: titles.len() }
    }

    /// Sets a minimum width of each column, so that a live table does not move when its numbers
    /// grow.
    #[must_use]
    pub fn at_least(mut self, widths: &[u16]) -> Self {
        for (column, width) in self.table.column_iter_mut().zip(widths) {
            let padded = width + column.padding_width();
            column.set_constraint(ColumnConstraint::LowerBoundary(Width::Fixed(padded)));
        }
        self
    }

    /// Aligns a column as words.
    #[must_use]
    pub fn with_words_in(mut self, column: usize) -> Self {
        if let Some(column) = self.table.column_mut(column) {
            column.set_cell_alignment(CellAlignment::Left);
        }
        self
    }

    /// Adds a row. Missing cells stay empty.
    pub fn row<T: Display>(&mut self, cells: impl IntoIterator<Item = T>) {
        let cells = cells.into_iter().map(|cell| cell.to_string());
        let empty = std::iter::repeat_with(String::new);
        self.table.add_row(cells.chain(empty).take(self.columns).collect::<Vec<_>>());
    }

    /// The lines, without blanks at their ends.
    pub fn text(&self) -> String {
        let lines: Vec<_> = self.table.lines().map(|line| line.trim_end().to_owned()).collect();
        lines.join("\n")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_start_at_the_left_and_numbers_end_at_the_right() {
        let mut table = TextTable::new(1, &["what", "ms", "with"]).with_words_in(2);
        table.row(["a long name", "1.5", "x"]);
        table.row(["b", "12.25"]);
        assert_eq!(
            table.text(),
            "what            ms  with\n\
             a long name    1.5  x\n\
             b            12.25"
        );
    }

    #[test]
    fn columns_keep_their_least_width() {
        let mut table = TextTable::new(1, &["a", "b"]).at_least(&[4, 6]);
        table.row(["1", "2"]);
        assert_eq!(table.text(), "a          b\n1          2");
    }
}
