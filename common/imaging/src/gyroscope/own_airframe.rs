//! Where the drone sees itself: what stays put in the picture while the camera turns.

use nalgebra::Vector3;

/// Cells of longitude; half as many of latitude.
const COLUMNS: usize = 48;
/// Only where a point must have moved by so many pixels does the comparison say anything.
const MIN_MOVED_PX: f64 = 0.7;
/// What was noted is halved after about so many points of a cell.
const MEMORY: f32 = 400.0;
/// So many points must have been seen in a cell before it is left out.
const MIN_POINTS: f32 = 60.0;
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

/// Where the drone sees itself.
#[derive(Debug, Clone)]
pub struct OwnAirframe {
    cells: Vec<Cell>,
}

impl Default for OwnAirframe {
    fn default() -> Self {
        Self { cells: vec![Cell::default(); COLUMNS * COLUMNS / 2] }
    }
}

/// The number of the cell that a direction is in.
fn cell_of(direction: Vector3<f32>) -> usize {
    let longitude = direction.y.atan2(direction.x);
    let column = ((0.5 - longitude / std::f32::consts::TAU) * COLUMNS as f32) as usize;
    let latitude = direction.z.clamp(-1.0, 1.0).asin();
    let rows = COLUMNS / 2;
    let row = ((0.5 - latitude / std::f32::consts::PI) * rows as f32) as usize;
    row.min(rows - 1) * COLUMNS + column.min(COLUMNS - 1)
}

impl OwnAirframe {
    /// Whether a direction shows the drone itself, as far as is known.
    pub fn is_at(&self, direction: Vector3<f32>) -> bool {
        let cell = &self.cells[cell_of(direction)];
        cell.points > MIN_POINTS && cell.turning > RATIO * cell.staying
    }

    /// Notes how well a point agrees with the later frame: `turning` with the rotation, `staying` without
    /// it, code values; it moves by `moved_px` between the two.
    pub fn note(&mut self, direction: Vector3<f32>, turning: f32, staying: f32, moved_px: f64) {
        if moved_px < MIN_MOVED_PX {
            return;
        }
        let cell = &mut self.cells[cell_of(direction)];
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
        let hidden = |cell: &&Cell| cell.points > MIN_POINTS && cell.turning > RATIO * cell.staying;
        self.cells.iter().filter(hidden).count() as f64 / self.cells.len() as f64
    }
}
