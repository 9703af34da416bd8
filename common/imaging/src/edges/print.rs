//! The printed pattern of a marker.

use crate::gaussian::Gaussian;

/// Width of the quiet zone around the black square, cells. The surroundings beyond it are ignored.
pub(super) const QUIET_ZONE_CELLS: f64 = 0.5;

/// A printed marker: black and white cells in a black border of one cell, on white.
#[derive(Debug, Clone, PartialEq)]
pub struct MarkerPrint {
    bits: usize,
    white: Vec<bool>,
}

impl MarkerPrint {
    /// A marker of these cells (true is white), row by row from the printed top left. `None` unless
    /// the cells form a square of at least two by two.
    pub fn of_bits(white: &[bool]) -> Option<Self> {
        let bits = white.len().isqrt();
        (bits >= 2 && bits * bits == white.len()).then(|| Self { bits, white: white.to_vec() })
    }

    /// Cells along a side of the black square, its border included: 7 for `DICT_5X5_250`.
    pub fn cells(&self) -> usize {
        self.bits + 2
    }

    /// Whether a cell is white. (0, 0) is the border's top left cell; all outside is white.
    pub fn is_white(&self, row: isize, column: isize) -> bool {
        let last = self.bits as isize + 1;
        let outside = row < 0 || column < 0 || row > last || column > last;
        let border = row == 0 || column == 0 || row == last || column == last;
        outside || (!border && self.white[(row as usize - 1) * self.bits + column as usize - 1])
    }

    /// Share of white in `row` at `column`, blurred along the row by a Gaussian of standard
    /// deviation `blur`, both in cells. Column 0 is the square's edge, 1 the border's inner edge.
    /// The marker is rotated clockwise by `quarters` of a turn, so that another side is its top.
    pub(super) fn white_share(&self, quarters: usize, row: isize, column: f64, blur: f64) -> f64 {
        let last = self.bits as isize + 1;
        let cell = |column: isize| match quarters {
            0 => self.is_white(row, column),
            1 => self.is_white(column, last - row),
            2 => self.is_white(last - row, last - column),
            _ => self.is_white(last - column, row),
        };
        let gaussian = Gaussian::get();
        let mut share = 1.0;
        let mut before = true;
        for column_edge in 0..=last + 1 {
            let white = cell(column_edge);
            if white != before {
                let (_, below) = gaussian.at(((column - column_edge as f64) / blur) as f32);
                let below = f64::from(below);
                share += if white { below } else { -below };
                before = white;
            }
        }
        share
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    fn print() -> MarkerPrint {
        // Top right and bottom left are white.
        MarkerPrint::of_bits(&[false, true, true, false]).unwrap()
    }

    #[test]
    fn cells_have_a_black_border_on_white() {
        let print = print();
        assert_eq!(print.cells(), 4);
        let row =
            |row: isize| (-1..=4).map(|column| print.is_white(row, column)).collect::<Vec<_>>();
        assert_eq!(row(-1), [true; 6]);
        assert_eq!(row(0), [true, false, false, false, false, true]);
        assert_eq!(row(1), [true, false, false, true, false, true]);
        assert_eq!(MarkerPrint::of_bits(&[true; 5]), None);
    }

    #[test]
    fn each_side_has_the_marker_rotated() {
        let print = MarkerPrint::of_bits(&[true, true, false, false]).unwrap();
        let share = |quarters, row, column| print.white_share(quarters, row, column, 0.05);
        let row = |quarters| [1.5, 2.5].map(|column| share(quarters, 1, column).round());
        assert_eq!(row(0), [1.0, 1.0]);
        // With the right side as the top, the printed top is on the left.
        assert_eq!(row(1), [1.0, 0.0]);
        assert_eq!(row(2), [0.0, 0.0]);
        assert_eq!(row(3), [0.0, 1.0]);
        assert!((share(0, 0, 0.0) - 0.5).abs() < 1e-6, "half of the border's end");
    }
}
