//! Reading what is printed in a square.
//!
//! Each cell's light is compared with that of the dictionary's markers *as they would look blurred*:
//! a white cell among black ones never becomes white in a small marker, and a threshold would call
//! it black. The measure is the correlation over the inner cells alone; the border, which all
//! markers share, only has to be there.

use flockeye_dictionary::Dictionary;
use flockeye_geometry::view::ViewPixel;
use flockeye_imaging::edges::MarkerPrint;
use flockeye_imaging::image::LumaImage;
use flockeye_imaging::light::LinearLight;
use flockeye_imaging::square::SquareInView;

/// Blurs that markers are drawn with, in cells: sharp, as at 20 px of side, as at 12.
const BLURS_CELLS: [f64; 3] = [0.15, 0.4, 0.65];

/// Where the quiet zone is looked at, cells outside the square's edge.
const QUIET_CELLS: f64 = 0.45;

/// The light of a square's cells.
pub(crate) struct Reading {
    /// Inner cells, row by row from the square's first corner.
    cells: Vec<f32>,
    /// How far the quiet zone outshines the border: the side where it does least, as a share of the
    /// contrast inside the square.
    quiet_zone: f32,
}

/// What a square reads as.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Decoded {
    pub id: u32,
    /// Which of the square's corners is the printed top left.
    pub first_corner: usize,
    /// Correlation with the marker, at most 1.
    pub agreement: f32,
    /// By how much this id is more likely than any other one: logarithm of the ratio.
    pub certainty: f32,
}

impl Reading {
    /// Reads the square with these corners. `None` where it or its quiet zone leaves the image, or
    /// where a side of the quiet zone is darker than the border.
    pub(crate) fn new(
        image: &LumaImage<'_>,
        light: &LinearLight,
        corners: &[ViewPixel; 4],
        bits: usize,
    ) -> Option<Self> {
        let square = SquareInView::new(corners)?;
        let count = (bits + 2) as f64;
        let at = |column: f64, row: f64| light.at(image, square.at(column / count, row / count));
        let cell = |column: usize, row: usize| -> Option<f32> {
            let (column, row) = (column as f64 + 0.5, row as f64 + 0.5);
            let mut sum = 0.0;
            for (dx, dy) in [(-0.2, -0.2), (0.2, -0.2), (0.2, 0.2), (-0.2, 0.2)] {
                sum += at(column + dx, row + dy)?;
            }
            Some(sum / 4.0)
        };
        // The quiet zone and the border's middle, side by side, for each side.
        let mut sides = [(0.0, 0.0); 4];
        for k in 1..=bits {
            let along = k as f64 + 0.5;
            let (near, far) = (0.5, count - 0.5);
            let (out_near, out_far) = (-QUIET_CELLS, count + QUIET_CELLS);
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
        // Most squares in a view are no markers: no more work for them.
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
        Some(Self { cells, quiet_zone })
    }

    /// How far the quiet zone outshines the border, as a share of the contrast, where it does least.
    pub(crate) fn quiet_zone(&self) -> f32 {
        self.quiet_zone
    }
}

/// Markers that are compared at once.
const LANES: usize = 16;

/// The markers of a dictionary, blurred, ready to be compared.
pub(crate) struct Reader {
    bits: usize,
    count: usize,
    /// For each blur, the inner cells of all markers, with mean 0 and norm 1: of each [`LANES`] markers
    /// the first cells, then the second ones, and so on. The last ones are filled up with zeros.
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

    /// How much a reading looks like each marker. `None` for a reading without contrast.
    pub(crate) fn compare(&self, reading: &Reading) -> Option<Likeness> {
        let mut turned = reading.cells.clone();
        if !normalise(&mut turned) {
            return None;
        }
        let cells = turned.len();
        let agreements = std::array::from_fn(|first_corner| {
            if first_corner > 0 {
                turned = turn(&turned, self.bits);
            }
            let mut best = vec![[f32::MIN; LANES]; self.count.div_ceil(LANES)];
            for templates in &self.templates {
                for (best, markers) in best.iter_mut().zip(templates.chunks_exact(cells)) {
                    let mut sums = [0.0; LANES];
                    for (template, cell) in markers.iter().zip(&turned) {
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
        Some(Likeness { cells, count: self.count, agreements })
    }
}

/// How much a reading looks like each marker of a dictionary.
pub(crate) struct Likeness {
    cells: usize,
    count: usize,
    /// For each turn of the square, the correlation with each marker at the blur that suits it best.
    agreements: [Vec<[f32; LANES]>; 4],
}

impl Likeness {
    /// The marker that it looks most like.
    pub(crate) fn best(&self) -> Option<Decoded> {
        self.best_among(0..self.count as u32)
    }

    /// The same among these ids, all of the dictionary; its certainty is that among them.
    pub(crate) fn best_among(&self, ids: impl Iterator<Item = u32> + Clone) -> Option<Decoded> {
        let mut best: Option<Decoded> = None;
        let mut runner_up: f32 = 0.0;
        for (first_corner, agreements) in self.agreements.iter().enumerate() {
            let agreements = agreements.as_flattened();
            for id in ids.clone() {
                let agreement = agreements[id as usize];
                match best {
                    Some(best) if agreement <= best.agreement => {
                        runner_up = runner_up.max(agreement);
                    }
                    _ => {
                        runner_up = best.map_or(0.0, |best| best.agreement).max(runner_up);
                        best = Some(Decoded { id, first_corner, agreement, certainty: 0.0 });
                    }
                }
            }
        }
        // Gaussian residuals of unknown size: their sum of squares is 1 - r^2 of the cells' own.
        let left_over = |agreement: f32| (1.0 - agreement * agreement).max(1e-4);
        best.map(|best| {
            let ratio = left_over(runner_up) / left_over(best.agreement);
            Decoded { certainty: 0.5 * self.cells as f32 * ratio.ln(), ..best }
        })
    }
}

/// The cells as they read when the square begins with its next corner.
fn turn(cells: &[f32], bits: usize) -> Vec<f32> {
    let mut turned = Vec::with_capacity(cells.len());
    for row in 0..bits {
        for column in 0..bits {
            turned.push(cells[column * bits + bits - 1 - row]);
        }
    }
    turned
}

/// Mean 0 and norm 1; false where all cells are alike.
fn normalise(cells: &mut [f32]) -> bool {
    let mean = cells.iter().sum::<f32>() / cells.len() as f32;
    let norm = cells.iter().map(|cell| (cell - mean) * (cell - mean)).sum::<f32>().sqrt();
    for cell in cells.iter_mut() {
        *cell = (*cell - mean) / norm.max(1e-12);
    }
    norm > 1e-4
}

/// Share that cells two before to two after have in the light of a cell's middle.
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

/// The inner cells of a marker, blurred along both axes, border and quiet zone included.
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

    /// Each correlation, one by one, and for each blur the largest.
    fn plainly(dictionary: &Dictionary, reading: &Reading, first_corner: usize, id: u32) -> f32 {
        let bits = dictionary.bits();
        let mut cells = reading.cells.clone();
        assert!(normalise(&mut cells));
        (0..first_corner).for_each(|_| cells = turn(&cells, bits));
        let correlation = |blur: f64| -> f32 {
            let mut drawn = draw(dictionary.print(id).unwrap(), bits, &kernel(blur));
            normalise(&mut drawn);
            drawn.iter().zip(&cells).map(|(a, b)| a * b).sum()
        };
        BLURS_CELLS.map(correlation).into_iter().fold(f32::MIN, f32::max)
    }

    #[test]
    fn markers_compared_at_once_are_those_compared_one_by_one() {
        // Neither number of markers is one of whole lanes.
        for name in ["DICT_5X5_250", "DICT_4X4_50"] {
            let dictionary = Dictionary::load(name).unwrap();
            let (bits, last) = (dictionary.bits(), dictionary.marker_count() as u32 - 1);
            let reader = Reader::new(&dictionary);
            // The last marker, turned once, with light of its own in each cell.
            let cells = draw(dictionary.print(last).unwrap(), bits, &kernel(0.3));
            let cells = turn(&turn(&turn(&cells, bits), bits), bits);
            let cells = cells.iter().enumerate().map(|(k, cell)| cell + 0.01 * (k % 7) as f32);
            let reading = Reading { cells: cells.collect(), quiet_zone: 1.0 };
            let likeness = reader.compare(&reading).unwrap();
            for first_corner in 0..4 {
                for id in 0..=last {
                    let found = likeness.agreements[first_corner].as_flattened()[id as usize];
                    let plain = plainly(&dictionary, &reading, first_corner, id);
                    assert!((found - plain).abs() < 1e-5, "{name} {id}: {found}, {plain}");
                }
            }
            let best = likeness.best().unwrap();
            assert_eq!((best.id, best.first_corner), (last, 1));
            assert!(best.agreement > 0.95 && best.certainty > 10.0, "{best:?}");
            let best = likeness.best_among([3, last, 7].into_iter()).unwrap();
            assert_eq!((best.id, best.first_corner), (last, 1));
            assert!(likeness.best_among(std::iter::empty()).is_none());
        }
        let flat = Reading { cells: vec![0.5; 25], quiet_zone: 1.0 };
        let dictionary = Dictionary::load("DICT_5X5_250").unwrap();
        assert!(Reader::new(&dictionary).compare(&flat).is_none());
    }
}
