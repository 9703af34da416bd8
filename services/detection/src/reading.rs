//! Reading what is printed in a square.
//!
//! The radiance of each cell is compared with that of the dictionary's markers *after blurring them*.
//! In a small marker a white cell among black ones never becomes white, and a threshold would read it
//! as black. The measure is the normalized correlation over the inner cells. The border, which all
//! markers share, only has to be there.

use flockeye_dictionary::Dictionary;
use flockeye_geometry::view::ViewPixel;
use flockeye_imaging::edges::MarkerPrint;
use flockeye_imaging::image::LumaImage;
use flockeye_imaging::light::LinearLight;
use flockeye_imaging::square::{SquareInView, mean_side_px};

/// Standard deviations of the blurs that markers are compared at, in cells: a sharp marker, one with a
/// side of 20 px, and one of 12 px, all with a lens's blur of about a pixel.
const BLURS_CELLS: [f64; 3] = [0.15, 0.4, 0.65];

/// Where the quiet zone is sampled, cells outside the square's edge: near the middle of its first cell in small markers.
const QUIET_CELLS: f64 = 0.45;

/// In large markers it is sampled so many pixels outside the edge, beyond the lens's blur, but no nearer than
/// [`MIN_QUIET_CELLS`]. Printed margins are often narrower than half a cell.
const QUIET_PX: f64 = 1.5;
const MIN_QUIET_CELLS: f64 = 0.2;

/// Places of a cell where its radiance is sampled, along both axes, cells from its middle.
const SAMPLE_CELLS: f64 = 0.2;

/// Least contrast of a reading that is compared: the norm of its cells' deviations from their mean, where
/// white paper has a radiance of up to 1. Below, there is nothing but rounding.
const MIN_CONTRAST: f32 = 1e-4;

/// Least share of the cells' variance that a marker is taken to leave unexplained. It bounds the likelihood
/// ratio of a perfect reading.
const MIN_RESIDUAL: f32 = 1e-4;

/// The radiance of a square's cells.
pub(crate) struct Reading {
    /// Inner cells, row by row from the square's first corner.
    cells: Vec<f32>,
    /// By how much the quiet zone is brighter than the border, as a share of the contrast inside the
    /// square: the least of the four sides.
    quiet_zone: f32,
    /// By how much the quiet zone is brighter than the border, mean of the four sides.
    edge_contrast: f32,
}

/// What a square reads as.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Decoded {
    pub id: u32,
    /// Which of the square's corners is the printed top left.
    pub first_corner: usize,
    /// Normalized correlation with the marker, at most 1.
    pub correlation: f32,
    /// Logarithm of the likelihood ratio of this id to the next likely one.
    pub log_likelihood_ratio: f32,
}

impl Reading {
    /// Reads the square with these corners. `None` if it or its quiet zone is not wholly inside the
    /// image, or if the quiet zone is darker than the border on some side.
    pub(crate) fn new(
        image: &LumaImage<'_>,
        light: &LinearLight,
        corners: &[ViewPixel; 4],
        bits: usize,
    ) -> Option<Self> {
        let square = SquareInView::new(corners)?;
        let count = (bits + 2) as f64;
        let cell_px = mean_side_px(corners) / count;
        let quiet_cells = (QUIET_PX / cell_px).clamp(MIN_QUIET_CELLS, QUIET_CELLS);
        let at = |column: f64, row: f64| light.at(image, square.at(column / count, row / count));
        let cell = |column: usize, row: usize| -> Option<f32> {
            let (column, row) = (column as f64 + 0.5, row as f64 + 0.5);
            let mut sum = 0.0;
            for (dx, dy) in [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)] {
                sum += at(column + dx * SAMPLE_CELLS, row + dy * SAMPLE_CELLS)?;
            }
            Some(sum / 4.0)
        };
        // For each side, the mean radiance of the quiet zone and that of the border beside it.
        let mut sides = [(0.0, 0.0); 4];
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
            for (sum, (quiet, border)) in sides.iter_mut().zip(pairs) {
                sum.0 += at(quiet.0, quiet.1)? / bits as f32;
                sum.1 += at(border.0, border.1)? / bits as f32;
            }
        }
        // Most squares in a view are no markers. They end here, at little cost.
        if sides.iter().any(|(quiet, border)| quiet <= border) {
            return None;
        }
        let mut cells = Vec::with_capacity(bits * bits);
        for row in 1..=bits {
            for column in 1..=bits {
                cells.push(cell(column, row)?);
            }
        }
        let lights = || cells.iter().copied().chain(sides.iter().flat_map(|s| [s.0, s.1]));
        let contrast = lights().fold(f32::MIN, f32::max) - lights().fold(f32::MAX, f32::min);
        let quiet_zone =
            sides.iter().map(|(quiet, border)| quiet - border).fold(f32::MAX, f32::min)
                / contrast.max(1e-6);
        let edge_contrast = sides.iter().map(|(quiet, border)| quiet - border).sum::<f32>() / 4.0;
        Some(Self { cells, quiet_zone, edge_contrast })
    }

    /// By how much the quiet zone is brighter than the border on the side where it is least so, as a share
    /// of the contrast.
    pub(crate) fn quiet_zone(&self) -> f32 {
        self.quiet_zone
    }
}

/// Markers that are compared at once: as many as two registers of AVX2 hold.
const LANES: usize = 16;

/// Compares readings with the blurred markers of a dictionary.
pub(crate) struct Reader {
    bits: usize,
    count: usize,
    /// For each blur, the inner cells of all markers, with mean 0 and norm 1. For each [`LANES`] markers
    /// come the first cells of all, then the second cells, and so on; the last lanes are zeros.
    templates: [Vec<[f32; LANES]>; BLURS_CELLS.len()],
}

impl Reader {
    pub(crate) fn new(dictionary: &Dictionary) -> Self {
        let (bits, count) = (dictionary.bits(), dictionary.marker_count());
        let templates = BLURS_CELLS.map(|blur| {
            let kernel = kernel(blur);
            let mut templates = vec![[0.0; LANES]; count.div_ceil(LANES) * bits * bits];
            for (id, print) in dictionary.prints().iter().enumerate() {
                let mut drawn = draw(print, bits, &kernel);
                normalise(&mut drawn);
                let first = id / LANES * bits * bits;
                for (lanes, cell) in templates[first..].iter_mut().zip(drawn) {
                    lanes[id % LANES] = cell;
                }
            }
            templates
        });
        Self { bits, count, templates }
    }

    /// By how much white cells are brighter than black ones if a reading shows this marker, as a share of what the quiet
    /// zone is brighter than the border.
    pub(crate) fn cell_contrast(&self, reading: &Reading, print: &MarkerPrint) -> f32 {
        let mean = reading.cells.iter().sum::<f32>() / reading.cells.len() as f32;
        // The slope of the reading over the blurred print, at the blur that explains most of it.
        let slope = BLURS_CELLS.map(|blur| {
            let drawn = draw(print, self.bits, &kernel(blur));
            let drawn_mean = drawn.iter().sum::<f32>() / drawn.len() as f32;
            let pairs = || drawn.iter().map(|cell| cell - drawn_mean).zip(&reading.cells);
            let product: f32 = pairs().map(|(drawn, cell)| drawn * (cell - mean)).sum();
            let square: f32 = pairs().map(|(drawn, _)| drawn * drawn).sum();
            (product * product / square.max(1e-9), product / square.max(1e-9))
        });
        let best = slope.into_iter().max_by(|a, b| a.0.total_cmp(&b.0));
        best.map_or(0.0, |(_, slope)| slope / reading.edge_contrast.max(1e-6))
    }

    /// Correlates a reading with each marker. `None` for a reading without contrast.
    pub(crate) fn compare(&self, reading: &Reading) -> Option<Correlations> {
        let mut rotated = reading.cells.clone();
        if !normalise(&mut rotated) {
            return None;
        }
        let cells = rotated.len();
        let by_rotation = std::array::from_fn(|first_corner| {
            if first_corner > 0 {
                rotated = rotate(&rotated, self.bits);
            }
            let mut best = vec![[f32::MIN; LANES]; self.count.div_ceil(LANES)];
            for templates in &self.templates {
                for (best, markers) in best.iter_mut().zip(templates.chunks_exact(cells)) {
                    let mut sums = [0.0; LANES];
                    for (template, cell) in markers.iter().zip(&rotated) {
                        for (sum, template) in sums.iter_mut().zip(template) {
                            *sum += template * cell;
                        }
                    }
                    for (best, sum) in best.iter_mut().zip(sums) {
                        *best = best.max(sum);
                    }
                }
            }
            best
        });
        Some(Correlations { cells, count: self.count, by_rotation })
    }
}

/// The correlation of a reading with each marker of a dictionary.
pub(crate) struct Correlations {
    cells: usize,
    count: usize,
    /// For each rotation of the square, the correlation with each marker at the best of the blurs.
    by_rotation: [Vec<[f32; LANES]>; 4],
}

impl Correlations {
    /// The marker with the largest correlation.
    pub(crate) fn best(&self) -> Option<Decoded> {
        self.best_among(0..self.count as u32)
    }

    /// The one with the largest correlation among these ids, which are of the dictionary. The likelihood
    /// ratio is that to the next of them.
    pub(crate) fn best_among(&self, ids: impl Iterator<Item = u32> + Clone) -> Option<Decoded> {
        let mut best: Option<Decoded> = None;
        let mut runner_up: f32 = 0.0;
        for (first_corner, correlations) in self.by_rotation.iter().enumerate() {
            let correlations = correlations.as_flattened();
            for id in ids.clone() {
                let correlation = correlations[id as usize];
                match best {
                    Some(best) if correlation <= best.correlation => {
                        runner_up = runner_up.max(correlation);
                    }
                    _ => {
                        runner_up = best.map_or(0.0, |best| best.correlation).max(runner_up);
                        best = Some(Decoded {
                            id,
                            first_corner,
                            correlation,
                            log_likelihood_ratio: 0.0,
                        });
                    }
                }
            }
        }
        // With Gaussian residuals of unknown variance, the log-likelihood is -n/2 ln(1 - r^2): a fit with
        // correlation r leaves the share 1 - r^2 of the sum of squares.
        let residual = |correlation: f32| (1.0 - correlation * correlation).max(MIN_RESIDUAL);
        best.map(|best| {
            let ratio = residual(runner_up) / residual(best.correlation);
            Decoded { log_likelihood_ratio: 0.5 * self.cells as f32 * ratio.ln(), ..best }
        })
    }
}

/// The cells read from the square's next corner on.
fn rotate(cells: &[f32], bits: usize) -> Vec<f32> {
    let mut rotated = Vec::with_capacity(cells.len());
    for row in 0..bits {
        for column in 0..bits {
            rotated.push(cells[column * bits + bits - 1 - row]);
        }
    }
    rotated
}

/// Shifts and scales cells to mean 0 and norm 1. False if they have no contrast.
fn normalise(cells: &mut [f32]) -> bool {
    let mean = cells.iter().sum::<f32>() / cells.len() as f32;
    let norm = cells.iter().map(|cell| (cell - mean) * (cell - mean)).sum::<f32>().sqrt();
    for cell in cells.iter_mut() {
        *cell = (*cell - mean) / norm.max(1e-12);
    }
    norm > MIN_CONTRAST
}

/// The weights of a cell and its two neighbours on either side in the radiance at the cell's middle,
/// after a Gaussian blur with this standard deviation, cells.
fn kernel(blur: f64) -> [f32; 5] {
    let steps = 40;
    let weights = [-2, -1, 0, 1, 2].map(|cell| {
        (0..steps)
            .map(|step| f64::from(cell) - 0.5 + (f64::from(step) + 0.5) / f64::from(steps))
            .map(|x| (-0.5 * (x / blur).powi(2)).exp())
            .sum::<f64>()
    });
    let total: f64 = weights.iter().sum();
    weights.map(|weight| (weight / total) as f32)
}

/// The inner cells of a marker, blurred along both axes together with its border and quiet zone.
fn draw(print: &MarkerPrint, bits: usize, kernel: &[f32; 5]) -> Vec<f32> {
    let mut cells = Vec::with_capacity(bits * bits);
    for row in 1..=bits as isize {
        for column in 1..=bits as isize {
            let mut sum = 0.0;
            for (by_row, weight) in (-2..=2).zip(kernel) {
                for (by_column, other) in (-2..=2).zip(kernel) {
                    if print.is_white(row + by_row, column + by_column) {
                        sum += weight * other;
                    }
                }
            }
            cells.push(sum);
        }
    }
    cells
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    /// The same correlation computed plainly: one marker, one blur at a time, and the largest.
    fn plain_correlation(
        dictionary: &Dictionary,
        reading: &Reading,
        first_corner: usize,
        id: u32,
    ) -> f32 {
        let bits = dictionary.bits();
        let mut cells = reading.cells.clone();
        assert!(normalise(&mut cells));
        (0..first_corner).for_each(|_| cells = rotate(&cells, bits));
        let correlation = |blur: f64| -> f32 {
            let mut drawn = draw(dictionary.print(id).unwrap(), bits, &kernel(blur));
            normalise(&mut drawn);
            drawn.iter().zip(&cells).map(|(a, b)| a * b).sum()
        };
        BLURS_CELLS.map(correlation).into_iter().fold(f32::MIN, f32::max)
    }

    #[test]
    fn comparing_many_markers_at_once_gives_the_plain_correlations() {
        // Neither number of markers is a multiple of the lanes.
        for name in ["DICT_5X5_250", "DICT_4X4_50"] {
            let dictionary = Dictionary::load(name).unwrap();
            let (bits, last) = (dictionary.bits(), dictionary.marker_count() as u32 - 1);
            let reader = Reader::new(&dictionary);
            // The last marker, rotated once, with a small error in each cell.
            let cells = draw(dictionary.print(last).unwrap(), bits, &kernel(0.3));
            let cells = rotate(&rotate(&rotate(&cells, bits), bits), bits);
            let cells = cells.iter().enumerate().map(|(k, cell)| cell + 0.01 * (k % 7) as f32);
            let reading = Reading { cells: cells.collect(), quiet_zone: 1.0, edge_contrast: 1.0 };
            let correlations = reader.compare(&reading).unwrap();
            for first_corner in 0..4 {
                for id in 0..=last {
                    let found = correlations.by_rotation[first_corner].as_flattened()[id as usize];
                    let plain = plain_correlation(&dictionary, &reading, first_corner, id);
                    assert!((found - plain).abs() < 1e-5, "{name} {id}: {found}, {plain}");
                }
            }
            let best = correlations.best().unwrap();
            assert_eq!((best.id, best.first_corner), (last, 1));
            assert!(best.correlation > 0.95 && best.log_likelihood_ratio > 10.0, "{best:?}");
            let best = correlations.best_among([3, last, 7].into_iter()).unwrap();
            assert_eq!((best.id, best.first_corner), (last, 1));
            assert!(correlations.best_among(std::iter::empty()).is_none());
        }
        let flat = Reading { cells: vec![0.5; 25], quiet_zone: 1.0, edge_contrast: 1.0 };
        let dictionary = Dictionary::load("DICT_5X5_250").unwrap();
        assert!(Reader::new(&dictionary).compare(&flat).is_none());
    }
}
