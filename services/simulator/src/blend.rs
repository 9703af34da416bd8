//! How a stitching camera makes one picture of those of its two lenses.

use std::ops::Range;

use flockeye_config::SimulatedStitch;

use crate::sensor::ImageSensor;
use crate::sphere::SphereGrid;

/// Blends the pictures of both lenses, and sharpens the result.
#[derive(Debug)]
pub(crate) struct Blend {
    /// Angle from the border up to which both lenses show, radians.
    half_rad: f32,
    /// Light of the lens behind, as a share of its light without the loss.
    behind: f32,
    sharpening: f32,
    /// Levels and sigmas of the lens behind in a row.
    levels_behind: Vec<u8>,
    sigmas_behind: Vec<u8>,
}

impl Blend {
    pub(crate) fn new(stitch: &SimulatedStitch) -> Self {
        Self {
            half_rad: (stitch.blend_deg / 2.0).to_radians() as f32,
            behind: (1.0 - stitch.darker) as f32,
            sharpening: stitch.sharpening as f32,
            levels_behind: Vec::new(),
            sigmas_behind: Vec::new(),
        }
    }

    /// Angle from the border up to which both lenses show, radians.
    pub(crate) fn half_rad(&self) -> f64 {
        self.half_rad.into()
    }

    /// Whether rows without a body stay as they are.
    pub(crate) fn keeps_backdrop(&self) -> bool {
        self.behind == 1.0
    }

    /// Draws a row of both lenses over `levels` and their noise, and blends them. `draw` composites
    /// what one lens sees, 0 ahead and 1 behind, over levels and sigmas.
    pub(crate) fn row(
        &mut self,
        row: usize,
        grid: &SphereGrid,
        sensor: &ImageSensor,
        levels: &mut [u8],
        sigmas: &mut [u8],
        mut draw: impl FnMut(usize, &mut [u8], &mut [u8]),
    ) {
        self.levels_behind.clear();
        self.levels_behind.extend_from_slice(levels);
        self.sigmas_behind.clear();
        self.sigmas_behind.extend_from_slice(sigmas);
        draw(0, levels, sigmas);
        draw(1, &mut self.levels_behind, &mut self.sigmas_behind);
        let [cos_row, _] = grid.rows[row];
        let behind = self.levels_behind.iter().zip(&self.sigmas_behind);
        let pixels = levels.iter_mut().zip(sigmas).zip(behind);
        for (([cos, _], (level, sigma)), (level_behind, sigma_behind)) in grid
            .columns
            .iter()
            .zip(pixels)
            .map(|(column, (ahead, behind))| ((column, ahead), behind))
        {
            let from_border = (cos_row * cos).asin();
            let share = match self.half_rad {
                half if from_border >= half => continue,
                half if from_border < -half => 0.0,
                half => 0.5 + 0.5 * from_border / half,
            };
            if share == 0.0 && self.keeps_backdrop() {
                (*level, *sigma) = (*level_behind, *sigma_behind);
                continue;
            }
            let of_behind = sensor.light(*level_behind) * self.behind;
            *level = sensor.level(share * sensor.light(*level) + (1.0 - share) * of_behind);
            *sigma = sensor.sigma(*level);
        }
    }

    /// Sharpens the finished picture in place: unsharp masking with a mean of three by three pixels.
    pub(crate) fn sharpen(&self, luma: &mut [u8], stride: usize, [width, height]: [usize; 2]) {
        if self.sharpening == 0.0 {
            return;
        }
        let rows = |at: usize| -> Range<usize> { at * stride..at * stride + width };
        let mut above = luma[rows(0)].to_vec();
        for row in 0..height {
            let own = luma[rows(row)].to_vec();
            let below = luma[rows((row + 1).min(height - 1))].to_vec();
            for (column, out) in luma[rows(row)].iter_mut().enumerate() {
                let beside = [(column + width - 1) % width, column, (column + 1) % width];
                let sum: u32 = [&above, &own, &below]
                    .into_iter()
                    .flat_map(|row| beside.map(|column| u32::from(row[column])))
                    .sum();
                let level = f32::from(own[column]);
                let sharpened = level + self.sharpening * (level - sum as f32 / 9.0);
                *out = sharpened.round().clamp(0.0, 255.0) as u8;
            }
            above = own;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::parameters::WorldParameters;

    #[test]
    fn halves_are_mixed_beside_the_border_only_and_one_is_darker() {
        let grid = SphereGrid::new(360, 180);
        let sensor = ImageSensor::new(&WorldParameters { iso: 0, ..Default::default() });
        let stitch = SimulatedStitch { blend_deg: 10.0, darker: 0.5, ..Default::default() };
        let (mut levels, mut sigmas) = (vec![0u8; 360], vec![0u8; 360]);
        let light = |level: u8| sensor.light(level);
        Blend::new(&stitch).row(90, &grid, &sensor, &mut levels, &mut sigmas, |lens, levels, _| {
            levels.fill(if lens == 0 { 200 } else { 100 });
        });
        assert_eq!(levels[180], 200, "straight ahead");
        assert!((light(levels[0]) / light(100) - 0.5).abs() < 0.02, "behind: {}", levels[0]);
        let at_border = light(levels[90]);
        let mean = (light(200) + 0.5 * light(100)) / 2.0;
        assert!((at_border / mean - 1.0).abs() < 0.1, "{at_border} {mean}");
        assert_eq!((levels[96], levels[263]), (200, 200));
    }

    #[test]
    fn sharpening_overshoots_at_edges_and_keeps_what_is_even() {
        let stitch = SimulatedStitch { sharpening: 0.9, ..Default::default() };
        let mut luma: Vec<u8> = (0..8 * 4).map(|k| if k % 8 < 4 { 60 } else { 160 }).collect();
        Blend::new(&stitch).sharpen(&mut luma, 8, [8, 4]);
        assert_eq!(luma[8 + 1..8 + 3], [60, 60]);
        assert!(luma[8 + 3] < 35 && luma[8 + 4] > 185, "{luma:?}");
    }
}
