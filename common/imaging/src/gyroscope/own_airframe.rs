//! Where the drone sees itself: what stays put in the picture while the camera turns.

use super::grid::CELL_COLUMNS;

/// Only where a point must have moved by so many pixels does the comparison say anything.
const MIN_MOVED_PX: f32 = 0.7;
/// What was noted is halved after about so many points of a cell.
const MEMORY: f32 = 180.0;
/// Least number of points seen in a cell before it is left out.
const MIN_CELL_POINTS: f32 = 13.0;
/// A cell is the airframe's where points that stay agree so many times better, in squares.
const RATIO: f32 = 2.0;
/// Residuals count up to this, code values.
const MAX_RESIDUAL: f32 = 20.0;

#[derive(Debug, Clone, Copy, Default)]
struct Cell {
    points: f32,
    turning: f32,
    staying: f32,
}

impl Cell {
    fn is_airframe(&self) -> bool {
        self.points > MIN_CELL_POINTS && self.turning > RATIO * self.staying
    }
}

/// Where the drone sees itself.
#[derive(Debug, Clone)]
pub struct OwnAirframe {
    cells: Vec<Cell>,
}

impl Default for OwnAirframe {
    fn default() -> Self {
        Self { cells: vec![Cell::default(); CELL_COLUMNS * CELL_COLUMNS / 2] }
    }
}

impl OwnAirframe {
    /// Whether a cell shows the drone itself, as far as is known.
    pub fn is_at(&self, cell: usize) -> bool {
        self.cells[cell].is_airframe()
    }

    /// Notes how well a point of a cell agrees with the later frame, code values: `turning` with the
    /// rotation, `staying` without it. The rotation moves it by `moved_px`.
    pub fn note(&mut self, cell: usize, turning: f32, staying: f32, moved_px: f32) {
        if moved_px < MIN_MOVED_PX {
            return;
        }
        let cell = &mut self.cells[cell];
        let squared = |residual: f32| residual.clamp(-MAX_RESIDUAL, MAX_RESIDUAL).powi(2);
        cell.points += 1.0;
        cell.turning += squared(turning);
        cell.staying += squared(staying);
        if cell.points > MEMORY {
            *cell = Cell {
                points: cell.points / 2.0,
                turning: cell.turning / 2.0,
                staying: cell.staying / 2.0,
            };
        }
    }

    /// The share of the cells that are left out.
    pub fn share(&self) -> f64 {
        let hidden = self.cells.iter().filter(|cell| cell.is_airframe());
        hidden.count() as f64 / self.cells.len() as f64
    }
}
