//! Detection of the own airframe: parts of the picture that stay in place while the camera turns.

/// Least motion of a point for a meaningful comparison, pixels.
const MIN_MOVED_PX: f32 = 0.7;
/// Number of points in a cell after which its statistics are halved.
const MEMORY: f32 = 180.0;
/// Least number of points in a cell before it is left out.
const MIN_CELL_POINTS: f32 = 13.0;
/// Ratio of squared residuals from which a cell belongs to the airframe, because staying points fit
/// better.
const RATIO: f32 = 2.0;
/// Limit on residuals, code values.
const MAX_RESIDUAL: f32 = 20.0;

/// Residuals of a cell's points if they turn with the world, and if they stay with the drone.
#[derive(Debug, Clone, Copy, Default)]
pub struct AirframeCell {
    points: f32,
    turning: f32,
    staying: f32,
}

impl AirframeCell {
    /// Whether the cell shows the drone itself, by its statistics.
    pub fn is_airframe(&self) -> bool {
        self.points > MIN_CELL_POINTS && self.turning > RATIO * self.staying
    }

    /// Records the residuals of a point of the cell in the later frame, code values: `turning` with
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
