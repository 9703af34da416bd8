//! The expected reading of a marker: its cells, and the steps between them, after a blur.

use flockeye_imaging::edges::MarkerPrint;

/// Places of a cell where its radiance is sampled, along both axes, cells from its middle.
pub(crate) const SAMPLE_CELLS: f64 = 0.2;

/// Radiance of black print, as a share of the difference between white paper and black. Camera
/// readings are scaled to this first, because glare adds to both, and ink differs.
pub(crate) const BLACK_SHARE: f32 = 0.1;

/// The widest blur that steps are compared at, cells.
pub(crate) const WIDEST_STEP_BLUR_CELLS: f64 = 0.4;

/// The largest step that counts: from black print to white paper, 2.4.
pub(crate) fn largest_step() -> f32 {
    ((1.0 + BLACK_SHARE) / BLACK_SHARE).ln()
}

/// Weights of a cell and its two neighbours on either side.
type Kernel = [f32; 5];

/// A marker, blurred along both axes by a Gaussian.
pub(crate) struct Drawn<'a> {
    print: &'a MarkerPrint,
    bits: usize,
    /// At the middle of a cell, and where its halves are sampled.
    middle: Kernel,
    halves: [Kernel; 2],
}

impl<'a> Drawn<'a> {
    /// The marker with a blur of this standard deviation, cells.
    pub(crate) fn new(print: &'a MarkerPrint, bits: usize, blur: f64) -> Self {
        let halves = [-SAMPLE_CELLS, SAMPLE_CELLS].map(|at| kernel(blur, at));
        Self { print, bits, middle: kernel(blur, 0.0), halves }
    }

    /// Share of white in the middle of each cell, border included, row by row.
    pub(crate) fn all_cells(&self) -> Vec<f32> {
        let all = 0..self.bits + 2;
        all.clone()
            .flat_map(|row| all.clone().map(move |column| (row, column)))
            .map(|at| self.white(at, &self.middle, &self.middle))
            .collect()
    }

    pub(crate) fn cells(&self) -> Vec<f32> {
        inner_cells(&self.all_cells(), self.bits)
    }

    pub(crate) fn steps(&self) -> Vec<f32> {
        let logs: Vec<f32> = self.all_cells().into_iter().map(log).collect();
        steps(&logs, self.bits)
    }

    /// The steps within each inner cell, row by row: from its left half to its right one, then from
    /// its upper half to its lower one.
    pub(crate) fn steps_within(&self) -> Vec<f32> {
        let inner = 1..=self.bits;
        let [first, second] = &self.halves;
        let mean: Kernel = std::array::from_fn(|k| (first[k] + second[k]) / 2.0);
        inner
            .clone()
            .flat_map(|row| inner.clone().map(move |column| (row, column)))
            .flat_map(|at| {
                let step = |from: f32, to: f32| log(to) - log(from);
                [
                    step(self.white(at, first, &mean), self.white(at, second, &mean)),
                    step(self.white(at, &mean, first), self.white(at, &mean, second)),
                ]
            })
            .collect()
    }

    /// Share of white where `along` and `down` weigh the columns and the rows around a cell.
    fn white(&self, (row, column): (usize, usize), along: &Kernel, down: &Kernel) -> f32 {
        let mut sum = 0.0;
        for (by_row, weight) in (-2..=2).zip(down) {
            for (by_column, other) in (-2..=2).zip(along) {
                if self.print.is_white(row as isize + by_row, column as isize + by_column) {
                    sum += weight * other;
                }
            }
        }
        sum
    }
}

fn log(white: f32) -> f32 {
    (white + BLACK_SHARE).ln()
}

/// Weights of a cell and its two neighbours on either side in the radiance at a point of the cell.
/// The point lies `at` cells from the middle; the blur is a Gaussian with this standard deviation,
/// cells.
fn kernel(blur: f64, at: f64) -> Kernel {
    let steps = 40;
    let weights = [-2, -1, 0, 1, 2].map(|cell| {
        (0..steps)
            .map(|step| f64::from(cell) - 0.5 + (f64::from(step) + 0.5) / f64::from(steps) - at)
            .map(|x| (-0.5 * (x / blur).powi(2)).exp())
            .sum::<f64>()
    });
    let total: f64 = weights.iter().sum();
    weights.map(|weight| (weight / total) as f32)
}

/// The inner cells of a square.
pub(crate) fn inner_cells(cells: &[f32], bits: usize) -> Vec<f32> {
    let row = |row: usize| &cells[row * (bits + 2) + 1..][..bits];
    (1..=bits).flat_map(row).copied().collect()
}

/// The cells read from the square's next corner on, `count` along a side.
pub(crate) fn rotate(cells: &[f32], count: usize) -> Vec<f32> {
    let mut rotated = Vec::with_capacity(cells.len());
    for row in 0..count {
        for column in 0..count {
            rotated.push(cells[column * count + count - 1 - row]);
        }
    }
    rotated
}

/// Steps between neighbours of which at least one is an inner cell.
pub(crate) fn step_count(bits: usize) -> usize {
    2 * bits * (bits + 1)
}

/// The steps between cells whose light has these logarithms, border included: along the rows, then
/// along the columns. Each counts at most as much as the step between black print and white paper.
pub(crate) fn steps(logs: &[f32], bits: usize) -> Vec<f32> {
    let (all, most) = (bits + 2, largest_step());
    let mut steps = Vec::with_capacity(step_count(bits));
    let step = |from: usize, to: usize| (logs[to] - logs[from]).clamp(-most, most);
    for across in 1..=bits {
        steps.extend((0..=bits).map(|k| step(across * all + k, across * all + k + 1)));
    }
    for across in 1..=bits {
        steps.extend((0..=bits).map(|k| step(k * all + across, (k + 1) * all + across)));
    }
    steps
}

/// Scales a vector to norm 1, and returns its norm.
pub(crate) fn normalise(values: &mut [f32]) -> f32 {
    let norm = values.iter().map(|value| value * value).sum::<f32>().sqrt();
    for value in values.iter_mut() {
        *value /= norm.max(1e-12);
    }
    norm
}

/// Shifts values to mean 0, then scales them to norm 1. Returns the norm.
pub(crate) fn normalise_about_mean(values: &mut [f32]) -> f32 {
    let mean = values.iter().sum::<f32>() / values.len() as f32;
    for value in values.iter_mut() {
        *value -= mean;
    }
    normalise(values)
}
