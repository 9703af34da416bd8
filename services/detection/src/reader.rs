//! Decoding of a reading: the marker that it shows.

use flockeye_dictionary::Dictionary;
use flockeye_imaging::edges::{Lighting, MarkerPrint};

use crate::drawn::{
    Drawn, WIDEST_STEP_BLUR_CELLS, normalise, normalise_about_mean, rotate, step_count, steps,
};
use crate::reading::Reading;

/// Standard deviations of the blurs that markers are compared at, in cells. They are those of a
/// sharp marker, one with a side of 20 px, and one of 12 px. All have a lens's blur of about a
/// pixel.
const BLURS_CELLS: [f64; 3] = [0.15, 0.4, 0.65];

/// The blurs that steps are compared at.
const STEP_BLURS_CELLS: [f64; 2] = [0.15, WIDEST_STEP_BLUR_CELLS];

/// Least contrast of a reading that is compared: the norm of its cells' deviations from their mean,
/// where white paper has a radiance of up to 1. Below, there are only rounding errors.
const MIN_CONTRAST: f32 = 1e-4;

/// Difference of print from its image that no fit explains, as a share of its contrast.
const MODEL_ERROR: f64 = 0.03;

/// Largest squared contrast of print, in variances of its cells: a seventh of them is white, or
/// black.
const CONTRAST_OF_VARIANCE: f64 = 8.0;

/// Independent values for each cell of a square that is no marker. With this share, and with the
/// uncertainty of corners, such squares become rarer by e for each unit of their log odds.
const INDEPENDENT_SHARE: f64 = 0.5;

/// Correlation of a square without a marker with the best of many markers. Squares of textures have
/// 0.64 to 0.69 in the median, those of real panoramas 0.72 to 0.76.
const NO_MARKER_CORRELATION: f32 = 0.65;

/// Result of decoding a square.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Decoded {
    pub id: u32,
    /// Index of the square's corner that is the printed top left.
    pub first_corner: usize,
    /// Normalized correlation with the marker, at most 1.
    correlation: f32,
    /// Correlation with the next likely marker or with a square without a marker, whichever is
    /// larger.
    runner_up: f32,
    cells: usize,
    /// Sum of the squares of the cells' deviations from their mean, where the contrast of the quiet
    /// zone with the border is 1.
    deviation: f64,
}

impl Decoded {
    /// Log odds of this marker against the next likely one and a square without a marker, by its
    /// cells.
    ///
    /// With Gaussian residuals of unknown variance, the log-likelihood is -n/2 ln(1 - r^2): a fit
    /// with correlation r leaves the share 1 - r^2 of the sum of squares. There are more steps than
    /// cells, but they follow from the cells. `misfit` is the deviation of the square's edges from
    /// those of print, as a share of its contrast. It is an error of each cell besides, and so is
    /// [`MODEL_ERROR`]. The contrast is the largest that the cells allow ([`CONTRAST_OF_VARIANCE`]),
    /// or that of the edges where the cells are fainter. So a pattern is no print if it is as faint
    /// as the errors of its edges.
    pub(crate) fn log_odds(&self, misfit: f64) -> f64 {
        let cells = self.cells as f64;
        let unexplained = |correlation: f32| {
            let share = 1.0 - f64::from(correlation).powi(2);
            self.deviation * share.max(0.0)
                + cells.max(CONTRAST_OF_VARIANCE * self.deviation)
                    * (misfit.powi(2) + MODEL_ERROR.powi(2))
        };
        let ratio = unexplained(self.runner_up) / unexplained(self.correlation);
        0.5 * INDEPENDENT_SHARE * cells * ratio.ln()
    }

    /// The marker after a closer comparison.
    pub(crate) fn with(self, explained: &Explained) -> Self {
        Self { correlation: explained.correlation(), ..self }
    }
}

/// Correlation of a marker with a reading, in either model of the light.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Explained {
    even: f32,
    uneven: f32,
}

impl Explained {
    /// The model of the light that explains more.
    pub(crate) fn lighting(&self) -> Lighting {
        if self.uneven > self.even { Lighting::Uneven } else { Lighting::Even }
    }

    /// Correlation in the better model: 1 is perfect.
    pub(crate) fn correlation(&self) -> f32 {
        self.even.max(self.uneven)
    }
}

/// Markers that are compared at once: as many as two registers of AVX2 hold.
const LANES: usize = 16;

/// Compares readings with the blurred markers of a dictionary.
pub(crate) struct MarkerReader {
    bits: usize,
    count: usize,
    /// For each blur, the inner cells of all markers, with mean 0 and norm 1.
    cells: [Lanes; BLURS_CELLS.len()],
    /// For each blur, the steps of all markers, with norm 1.
    steps: [Lanes; STEP_BLURS_CELLS.len()],
}

/// A vector for each marker. For each [`LANES`] markers come the first elements of all, then the
/// second elements, and so on; the last lanes are zeros.
struct Lanes {
    /// Elements of a vector.
    length: usize,
    elements: Vec<[f32; LANES]>,
}

impl Lanes {
    /// `of` gives the vector of a marker.
    fn new(dictionary: &Dictionary, length: usize, of: impl Fn(&MarkerPrint) -> Vec<f32>) -> Self {
        let mut elements = vec![[0.0; LANES]; dictionary.marker_count().div_ceil(LANES) * length];
        for (id, print) in dictionary.prints().iter().enumerate() {
            let first = id / LANES * length;
            for (lanes, element) in elements[first..].iter_mut().zip(of(print)) {
                lanes[id % LANES] = element;
            }
        }
        Self { length, elements }
    }

    /// Raises each marker's `best` to its product with `read`.
    fn compare(&self, read: &[f32], best: &mut [[f32; LANES]]) {
        for (best, markers) in best.iter_mut().zip(self.elements.chunks_exact(self.length)) {
            let mut sums = [0.0; LANES];
            for (lanes, element) in markers.iter().zip(read) {
                for (sum, lane) in sums.iter_mut().zip(lanes) {
                    *sum += lane * element;
                }
            }
            for (best, sum) in best.iter_mut().zip(sums) {
                *best = best.max(sum);
            }
        }
    }
}

impl MarkerReader {
    pub(crate) fn new(dictionary: &Dictionary) -> Self {
        let (bits, count) = (dictionary.bits(), dictionary.marker_count());
        let cells = BLURS_CELLS.map(|blur| {
            Lanes::new(dictionary, bits * bits, |print| drawn_cells(print, bits, blur))
        });
        let steps = STEP_BLURS_CELLS.map(|blur| {
            Lanes::new(dictionary, step_count(bits), |print| drawn_steps(print, bits, blur))
        });
        Self { bits, count, cells, steps }
    }

    /// Correlates a marker with a reading that begins at its printed top left.
    ///
    /// Unlike [`Self::compare`] it also looks within the cells: print changes at their edges alone.
    /// Squares of another size read as a marker where cells are grey, half white and half black.
    pub(crate) fn explain(&self, reading: &Reading, print: &MarkerPrint) -> Explained {
        let mut cells = reading.cells.clone();
        normalise_about_mean(&mut cells);
        let even = BLURS_CELLS.map(|blur| product(&drawn_cells(print, self.bits, blur), &cells));
        let uneven = reading.steps.as_ref().map_or(0.0, |read| {
            let read = joined(steps(&read.logs, self.bits), &read.within);
            let at = |blur| {
                let drawn = Drawn::new(print, self.bits, blur);
                product(&joined(drawn.steps(), &drawn.steps_within()), &read)
            };
            STEP_BLURS_CELLS.into_iter().map(at).fold(0.0, f32::max)
        });
        Explained { even: even.into_iter().fold(0.0, f32::max), uneven }
    }

    /// Correlates a reading with each marker. `None` for a reading without contrast.
    pub(crate) fn compare(&self, reading: &Reading) -> Option<Correlations> {
        let mut cells = reading.cells.clone();
        let mut logs = reading.steps.as_ref().map(|steps| steps.logs.clone());
        let norm = normalise_about_mean(&mut cells);
        if norm < MIN_CONTRAST {
            return None;
        }
        let deviation = f64::from(norm / reading.edge_contrast).powi(2);
        let by_rotation = std::array::from_fn(|first_corner| {
            if first_corner > 0 {
                cells = rotate(&cells, self.bits);
                logs = logs.as_ref().map(|logs| rotate(logs, self.bits + 2));
            }
            let mut best = vec![[f32::MIN; LANES]; self.count.div_ceil(LANES)];
            for markers in &self.cells {
                markers.compare(&cells, &mut best);
            }
            if let Some(logs) = &logs {
                let mut read = steps(logs, self.bits);
                normalise(&mut read);
                for markers in &self.steps {
                    markers.compare(&read, &mut best);
                }
            }
            best
        });
        let (cells, count) = (self.bits * self.bits, self.count);
        Some(Correlations { cells, deviation, count, by_rotation })
    }
}

/// The correlation of a reading with each marker of a dictionary.
pub(crate) struct Correlations {
    cells: usize,
    deviation: f64,
    count: usize,
    /// For each rotation of the square, the correlation with each marker in the better model of the
    /// light, at the best blur.
    by_rotation: [Vec<[f32; LANES]>; 4],
}

impl Correlations {
    /// The marker with the largest correlation. `None` for an empty dictionary.
    pub(crate) fn best(&self) -> Option<Decoded> {
        let mut best: Option<(f32, u32, usize)> = None;
        let mut runner_up = NO_MARKER_CORRELATION;
        for (first_corner, correlations) in self.by_rotation.iter().enumerate() {
            let correlations = &correlations.as_flattened()[..self.count];
            for (id, &correlation) in (0..).zip(correlations) {
                let (largest, ..) = best.unwrap_or((f32::MIN, 0, 0));
                runner_up = runner_up.max(correlation.min(largest));
                if correlation > largest {
                    best = Some((correlation, id, first_corner));
                }
            }
        }
        let (correlation, id, first_corner) = best?;
        let (cells, deviation) = (self.cells, self.deviation);
        Some(Decoded { id, first_corner, correlation, runner_up, cells, deviation })
    }
}

fn product(one: &[f32], other: &[f32]) -> f32 {
    one.iter().zip(other).map(|(a, b)| a * b).sum()
}

/// Steps between cells and within them as one vector, with norm 1.
fn joined(mut between: Vec<f32>, within: &[f32]) -> Vec<f32> {
    between.extend(within);
    normalise(&mut between);
    between
}

/// The inner cells of a marker, with mean 0 and norm 1.
fn drawn_cells(print: &MarkerPrint, bits: usize, blur: f64) -> Vec<f32> {
    let mut drawn = Drawn::new(print, bits, blur).cells();
    normalise_about_mean(&mut drawn);
    drawn
}

/// The steps of a marker, with norm 1.
fn drawn_steps(print: &MarkerPrint, bits: usize, blur: f64) -> Vec<f32> {
    let mut drawn = Drawn::new(print, bits, blur).steps();
    normalise(&mut drawn);
    drawn
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;
    use crate::drawn::{BLACK_SHARE, inner_cells};
    use crate::reading::Steps;

    /// What is read where all cells, border included, have these shares of white, in the light of
    /// each, and where the steps within them are those of `within`.
    fn lit(white: &[f32], bits: usize, within: Vec<f32>, light: impl Fn(usize) -> f32) -> Reading {
        let lit = |(k, white): (usize, &f32)| light(k) * (white + BLACK_SHARE);
        let logs = white.iter().enumerate().map(lit).map(f32::ln).collect();
        let all: Vec<f32> = white.iter().enumerate().map(lit).collect();
        let steps = Some(Steps { logs, within });
        Reading { cells: inner_cells(&all, bits), steps, quiet_zone: 1.0, edge_contrast: 1.0 }
    }

    /// The reading in even light, without steps within cells.
    fn reading(white: &[f32], bits: usize) -> Reading {
        lit(white, bits, vec![0.0; 2 * bits * bits], |_| 1.0)
    }

    /// The same correlation computed plainly: one marker, one blur at a time, and the largest.
    fn plain_correlation(
        dictionary: &Dictionary,
        reading: &Reading,
        first_corner: usize,
        id: u32,
    ) -> f32 {
        let (bits, print) = (dictionary.bits(), dictionary.print(id).unwrap());
        let (mut cells, mut logs) =
            (reading.cells.clone(), reading.steps.as_ref().unwrap().logs.clone());
        normalise_about_mean(&mut cells);
        (0..first_corner).for_each(|_| cells = rotate(&cells, bits));
        (0..first_corner).for_each(|_| logs = rotate(&logs, bits + 2));
        let mut read = steps(&logs, bits);
        normalise(&mut read);
        let product = |a: Vec<f32>, b: &[f32]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f32>();
        let even = BLURS_CELLS.map(|blur| product(drawn_cells(print, bits, blur), &cells));
        let local = STEP_BLURS_CELLS.map(|blur| product(drawn_steps(print, bits, blur), &read));
        even.into_iter().chain(local).fold(f32::MIN, f32::max)
    }

    #[test]
    fn log_odds_fall_with_the_misfit_of_the_edges_and_where_the_pattern_is_faint() {
        let log_odds = |correlation: f32, deviation: f64, misfit: f64| {
            let runner_up = NO_MARKER_CORRELATION;
            Decoded { id: 0, first_corner: 0, correlation, runner_up, cells: 25, deviation }
                .log_odds(misfit)
        };
        // Half of the cells are white: their squared deviations add up to a quarter of their number.
        let print = 25.0 / 4.0;
        assert!(log_odds(NO_MARKER_CORRELATION, print, 0.05).abs() < 1e-9);
        assert!(log_odds(0.97, print, 0.05) > log_odds(0.95, print, 0.05));
        assert!(log_odds(0.95, print, 0.05) > log_odds(0.95, print, 0.15));
        assert!(log_odds(0.9999, print, 0.05) > 4.0);
        // A hundredth of the contrast.
        assert!(log_odds(0.9999, print * 1e-4, 0.05) < 0.1);
    }

    #[test]
    fn comparing_many_markers_at_once_gives_the_plain_correlations() {
        // Neither number of markers is a multiple of the lanes.
        for name in ["DICT_5X5_250", "DICT_4X4_50"] {
            let dictionary = Dictionary::load(name).unwrap();
            let (bits, last) = (dictionary.bits(), dictionary.marker_count() as u32 - 1);
            let reader = MarkerReader::new(&dictionary);
            // The last marker, rotated once, with a small error in each cell.
            let mut cells = Drawn::new(dictionary.print(last).unwrap(), bits, 0.3).all_cells();
            (0..3).for_each(|_| cells = rotate(&cells, bits + 2));
            cells.iter_mut().enumerate().for_each(|(k, cell)| *cell += 0.01 * (k % 7) as f32);
            let reading = reading(&cells, bits);
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
            assert!(best.correlation > 0.95 && best.log_odds(0.0) > 4.0, "{best:?}");
        }
        let dictionary = Dictionary::load("DICT_5X5_250").unwrap();
        assert!(MarkerReader::new(&dictionary).compare(&reading(&[0.5; 49], 5)).is_none());
    }

    #[test]
    fn the_edge_of_a_shadow_changes_a_reading_little() {
        let dictionary = Dictionary::load("DICT_6X6_250").unwrap();
        let (bits, reader) = (dictionary.bits(), MarkerReader::new(&dictionary));
        for (id, print) in dictionary.prints().iter().enumerate() {
            let white = Drawn::new(print, bits, 0.2).all_cells();
            // Right of the diagonal there is an eighth of the light.
            let light = |k: usize| if k % (bits + 2) > k / (bits + 2) { 0.125 } else { 1.0 };
            let reading = lit(&white, bits, vec![0.0; 2 * bits * bits], light);
            let best = reader.compare(&reading).unwrap().best().unwrap();
            assert_eq!((best.id as usize, best.first_corner), (id, 0), "{best:?}");
            assert!(best.correlation > 0.8 && best.log_odds(0.0) > 4.0, "{best:?}");
        }
    }

    #[test]
    fn the_likelier_model_of_the_light_counts() {
        let dictionary = Dictionary::load("DICT_6X6_250").unwrap();
        let (bits, reader) = (dictionary.bits(), MarkerReader::new(&dictionary));
        let print = dictionary.print(7).unwrap();
        let drawn = Drawn::new(print, bits, 0.2);
        let lit_by = |light: &dyn Fn(usize) -> f32| {
            let reading = lit(&drawn.all_cells(), bits, drawn.steps_within(), light);
            reader.explain(&reading, print)
        };
        assert_eq!(lit_by(&|_| 0.5).lighting(), Lighting::Even);
        let shaded = lit_by(&|k| if k % (bits + 2) < 4 { 0.2 } else { 1.0 });
        assert_eq!(shaded.lighting(), Lighting::Uneven);
        assert!(shaded.correlation() > 0.9, "{shaded:?}");
    }

    #[test]
    fn grey_cells_explain_less_than_cells_of_one_colour() {
        let dictionary = Dictionary::load("DICT_4X4_250").unwrap();
        let (bits, reader) = (dictionary.bits(), MarkerReader::new(&dictionary));
        let print = dictionary.print(3).unwrap();
        let white = Drawn::new(print, bits, 0.15).all_cells();
        let alike = reader.explain(&reading(&white, bits), print).uneven;
        // From the left half of each cell to the right one there is half of the largest step.
        let half_white = lit(&white, bits, [-1.2, 0.0].repeat(bits * bits), |_| 1.0);
        let grey = reader.explain(&half_white, print).uneven;
        assert!(alike > 0.99 && grey < 0.93, "{alike}, {grey}");
    }
}
