//! Reading of the print in a square.
//!
//! The reading of a square is compared with the dictionary's markers *after blurring them*. In a
//! small marker a white cell among black ones never becomes white, and a threshold would read it as
//! black. The measure is the normalized correlation, in two models of the light, of which the
//! better one counts:
//!
//! - **Even light**: the radiance of the inner cells. It is best where cells are hardly wider than
//!   the blur, or where white saturates.
//! - **Light from place to place**: white in the shade may be darker than black in the sun, so a
//!   cell by itself has little information. But light changes little from a cell to its neighbour,
//!   while print changes much. So the *steps* between neighbouring cells are compared, differences
//!   of the logarithm of their radiance. Where the edge of a shadow crosses the marker, only the
//!   steps across that edge are wrong.

use flockeye_geometry::view::ViewPixel;
use flockeye_imaging::image::LumaImage;
use flockeye_imaging::light::LinearLight;
use flockeye_imaging::square::{SquareInView, mean_side_px};

use crate::drawn::{BLACK_SHARE, SAMPLE_CELLS, WIDEST_STEP_BLUR_CELLS, largest_step};

/// Distance of the quiet zone's samples from the square's edge, cells: near the middle of its first
/// cell in small markers.
const QUIET_CELLS: f64 = 0.45;

/// Distance of its samples from the edge in large markers, pixels: beyond the lens's blur, but no
/// nearer than [`MIN_QUIET_CELLS`]. Printed margins are often narrower than half a cell.
const QUIET_PX: f64 = 1.5;
const MIN_QUIET_CELLS: f64 = 0.2;

/// A lens's blur, pixels of the sphere. Steps are compared where it is no wider than the widest
/// blur that they are drawn with. The logarithm of a narrower cell depends more on the blur than on
/// the print.
const LENS_BLUR_PX: f64 = 1.0;

/// Least light of a cell, as a share of the quiet zone's, after glare was taken off both. It bounds
/// the logarithm.
const MIN_LIGHT_SHARE: f32 = 0.02;

/// The light of a square's cells.
pub(crate) struct Reading {
    /// Radiance of the inner cells, row by row from the square's first corner.
    pub(crate) cells: Vec<f32>,
    /// The light from place to place, where cells are wide enough for it.
    pub(crate) steps: Option<Steps>,
    /// Mean step from the border out to the quiet zone, as a share of that from black print to
    /// white paper: the least of the four sides.
    pub(crate) quiet_zone: f32,
    /// Contrast of the quiet zone with the border, mean of the four sides.
    pub(crate) edge_contrast: f32,
}

/// Logarithms of the light, from which steps are computed.
pub(crate) struct Steps {
    /// Logarithm of the light of all cells, border included, row by row from the square's first
    /// corner.
    pub(crate) logs: Vec<f32>,
    /// Steps within the inner cells, in the same order: from the left half to the right one, and
    /// from the upper half to the lower one.
    pub(crate) within: Vec<f32>,
}

impl Reading {
    /// Reads the square with these corners, in a view with `magnification` pixels for each of the
    /// sphere's. `None` if it or its quiet zone is not wholly inside the image, or if the quiet
    /// zone is darker than the border on some side.
    pub(crate) fn new(
        image: &LumaImage<'_>,
        light: &LinearLight,
        corners: &[ViewPixel; 4],
        bits: usize,
        magnification: f64,
    ) -> Option<Self> {
        let square = SquareInView::new(corners)?;
        let count = (bits + 2) as f64;
        let cell_px = mean_side_px(corners) / count;
        let side_px = |k: usize| (corners[(k + 1) % 4].0 - corners[k].0).norm();
        let narrowest_px = (0..4).map(side_px).fold(f64::INFINITY, f64::min) / count;
        let blur_cells = LENS_BLUR_PX * magnification.max(1.0) / narrowest_px;
        let quiet_cells = (QUIET_PX / cell_px).clamp(MIN_QUIET_CELLS, QUIET_CELLS);
        let at = |column: f64, row: f64| light.at(image, square.at(column / count, row / count));
        // The four samples of a cell: upper left, upper right, lower right, lower left.
        let cell = |column: usize, row: usize| -> Option<[f32; 4]> {
            let (column, row) = (column as f64 + 0.5, row as f64 + 0.5);
            let sample = |dx: f64, dy: f64| at(column + dx * SAMPLE_CELLS, row + dy * SAMPLE_CELLS);
            Some([sample(-1.0, -1.0)?, sample(1.0, -1.0)?, sample(1.0, 1.0)?, sample(-1.0, 1.0)?])
        };
        // For each side, the radiance of the quiet zone and that of the border beside it.
        let mut sides: [Side; 4] = [const { Vec::new() }; 4];
        for k in 1..=bits {
            let along = k as f64 + 0.5;
            let (near, far) = (0.5, count - 0.5);
            let (out_near, out_far) = (-quiet_cells, count + quiet_cells);
            let pairs = [
                ((along, out_near), (along, near)),
                ((out_far, along), (far, along)),
                ((along, out_far), (along, far)),
                ((out_near, along), (near, along)),
            ];
            for (side, (quiet, border)) in sides.iter_mut().zip(pairs) {
                side.push((at(quiet.0, quiet.1)?, at(border.0, border.1)?));
            }
        }
        let mean = |side: &Side| {
            let (quiet, border) =
                side.iter().fold((0.0, 0.0), |sum, at| (sum.0 + at.0, sum.1 + at.1));
            (quiet / bits as f32, border / bits as f32)
        };
        let means = sides.each_ref().map(mean);
        // Most squares in a view are no markers. They end here, at little cost.
        if means.iter().any(|(quiet, border)| quiet <= border) {
            return None;
        }
        let quiet = means.iter().map(|side| side.0).sum::<f32>() / 4.0;
        let border = means.iter().map(|side| side.1).sum::<f32>() / 4.0;
        // With this offset the border is as dark beside the quiet zone as black print beside white
        // paper.
        let white_over_black = (1.0 + BLACK_SHARE) / BLACK_SHARE;
        let offset = (quiet - white_over_black * border) / (white_over_black - 1.0);
        let log = |radiance: f32| (radiance + offset).max(MIN_LIGHT_SHARE * (quiet + offset)).ln();
        let outwards = |side: &Side| {
            side.iter().map(|&(quiet, border)| log(quiet) - log(border)).sum::<f32>() / bits as f32
        };
        let quiet_zone =
            sides.each_ref().map(outwards).into_iter().fold(f32::MAX, f32::min) / largest_step();
        let mut samples = Vec::with_capacity(bits * bits);
        for row in 1..=bits {
            for column in 1..=bits {
                samples.push(cell(column, row)?);
            }
        }
        let cells: Vec<f32> = samples.iter().map(|of| of.iter().sum::<f32>() / 4.0).collect();
        let steps = (blur_cells <= WIDEST_STEP_BLUR_CELLS).then(|| {
            let radiance = all_cells(&cells, &sides, border, bits);
            Steps {
                logs: radiance.into_iter().map(log).collect(),
                within: samples.iter().flat_map(|samples| steps_within(samples, log)).collect(),
            }
        });
        Some(Self { cells, steps, quiet_zone, edge_contrast: quiet - border })
    }
}

/// The radiance of the quiet zone and of the border beside it, along one side.
type Side = Vec<(f32, f32)>;

/// The radiance of all cells, of which `sides` has the border's. No step goes to the border's
/// corners: they have `corner`.
fn all_cells(
    cells: &[f32],
    [top, right, bottom, left]: &[Side; 4],
    corner: f32,
    bits: usize,
) -> Vec<f32> {
    let end = |side: &Side| {
        let border = side.iter().map(|at| at.1);
        std::iter::once(corner).chain(border).chain([corner]).collect::<Vec<f32>>()
    };
    let mut all = end(top);
    for (row, inner) in cells.chunks_exact(bits).enumerate() {
        all.push(left[row].1);
        all.extend(inner);
        all.push(right[row].1);
    }
    all.extend(end(bottom));
    all
}

/// The steps within a cell, from its four samples.
fn steps_within([a, b, c, d]: &[f32; 4], log: impl Fn(f32) -> f32) -> [f32; 2] {
    let most = largest_step();
    let step = |from: f32, to: f32| (log(to / 2.0) - log(from / 2.0)).clamp(-most, most);
    [step(a + d, b + c), step(a + b, c + d)]
}
