//! Where the drone sees itself: what stays put in the picture while the camera turns.

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

/// How well the points of a cell agree that turn with the world, and that stay with the drone.
#[derive(Debug, Clone, Copy, Default)]
pub struct AirframeCell {
    points: f32,
    turning: f32,
    staying: f32,
}

impl AirframeCell {
    /// Whether the cell shows the drone itself, as far as is known.
    pub fn is_airframe(&self) -> bool {
        self.points > MIN_CELL_POINTS && self.turning > RATIO * self.staying
    }

    /// Notes how well a point of the cell agrees with the later frame, code values: `turning` with
    /// the rotation, `staying` without it. The rotation moves it by `moved_px`.
    pub fn note(&mut self, turning: f32, staying: f32, moved_px: f32) {
        if moved_px < MIN_MOVED_PX {
            return;
        }
        let squared = |residual: f32| residual.clamp(-MAX_RESIDUAL, MAX_RESIDUAL).powi(2);
        self.points += 1.0;
        self.turning += squared(turning);
        self.staying += squared(staying);
        if self.points > MEMORY {
            for sum in [&mut self.points, &mut self.turning, &mut self.staying] {
                *sum /= 2.0;
            }
        }
    }
}
