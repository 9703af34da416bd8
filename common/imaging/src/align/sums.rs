//! The normal equations, summed over samples.
//!
//! Samples that show the same facets depend on the same few unknowns. They are summed as a bundle of
//! fixed size first, which the compiler adds four numbers at a time, and spread out once.

use nalgebra::{DMatrix, DVector};

use super::patch::Patch;
use super::print::BodyPrint;
use super::samples::Sample;
use super::solve::{Modelled, Scene, model};
use super::unknowns::{COMMON, Layout, State};

/// Scale of Cauchy's function, standard deviations.
const CAUCHY: f64 = 2.4;

/// A residual of so many deviations, squared, weighs 1 / (1 + this): Cauchy's function.
#[inline(always)]
pub(super) fn damping(squared_deviations: f64) -> f64 {
    squared_deviations / CAUCHY.powi(2)
}

/// Length of a row for a pixel that shows one facet: pose and blur, the two slopes of the light of the
/// facet that it lies on, two levels, the residual.
const INSIDE: usize = LEVELS + 2 + 1;
/// For one at the edges of up to three: and two seams more.
const ACROSS: usize = LEVELS + 6 + 2 + 1;
/// Where a row has its levels.
const LEVELS: usize = COMMON + 2;

/// Sums over the samples.
pub(super) struct Sums {
    pub normal: DMatrix<f64>,
    pub right: DVector<f64>,
    pub residuals: Vec<f32>,
}

/// One pass over the samples.
pub(super) struct Pass<'s> {
    pub print: &'s BodyPrint,
    pub patch: &'s Patch,
    pub samples: &'s [Sample],
    pub layout: &'s Layout,
    /// Noise of each facet.
    pub scales: &'s [f64],
    /// Whether residuals beyond the noise weigh less.
    pub is_robust: bool,
}

/// Sums over pixels of the same unknowns, of `ROW` numbers each, the residual the last.
struct Bundle<const ROW: usize> {
    /// Where the row's numbers stand among the unknowns.
    places: [Option<usize>; ROW],
    products: [[f32; ROW]; ROW],
}

impl<const ROW: usize> Bundle<ROW> {
    /// For pixels that lie on this facet.
    fn new(facet: usize, modelled: &Modelled, layout: &Layout) -> Self {
        let mut places = [None; ROW];
        for (k, place) in places.iter_mut().enumerate().take(COMMON) {
            *place = Some(k);
        }
        let slope = layout.slope(facet);
        places[COMMON] = slope;
        places[COMMON + 1] = slope.map(|at| at + 1);
        for (k, &(facet, ..)) in modelled.levels().iter().enumerate() {
            let at = layout.level(facet);
            places[LEVELS + 2 * k] = at;
            places[LEVELS + 2 * k + 1] = at.map(|at| at + 1);
        }
        for (k, &(seam, _)) in modelled.seams().iter().enumerate() {
            places[ROW - 3 + k] = layout.seam(seam);
        }
        Self { places, products: [[0.0; ROW]; ROW] }
    }

    #[inline(always)]
    fn add(&mut self, row: &[f32; ROW], weight: f32) {
        // All of it, though half would do: so the compiler adds four numbers at a time.
        for (products, first) in self.products.iter_mut().zip(row) {
            let weighted = weight * first;
            for (product, second) in products.iter_mut().zip(row) {
                *product += weighted * second;
            }
        }
    }

    fn add_to(&self, sums: &mut Sums) {
        for (row, at) in self.places.iter().enumerate() {
            let Some(at) = *at else { continue };
            for (column, to) in self.places.iter().enumerate() {
                if let Some(to) = *to {
                    sums.normal[(at, to)] += f64::from(self.products[row][column]);
                }
            }
            sums.right[at] += f64::from(self.products[row][ROW - 1]);
        }
    }
}

impl Pass<'_> {
    pub fn sum(&self, scene: &Scene<'_>, state: &State) -> Sums {
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has AVX2, as was asked just now.
            return unsafe { self.sum_avx2(scene, state) };
        }
        self.sum_plain(scene, state)
    }

    /// The same code, and the same sums to the last bit, with eight numbers in a register.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn sum_avx2(&self, scene: &Scene<'_>, state: &State) -> Sums {
        self.sum_plain(scene, state)
    }

    #[inline(always)]
    fn sum_plain(&self, scene: &Scene<'_>, state: &State) -> Sums {
        let unknowns = self.layout.count;
        let mut sums = Sums {
            normal: DMatrix::zeros(unknowns, unknowns),
            right: DVector::zeros(unknowns),
            residuals: Vec::with_capacity(self.samples.len()),
        };
        // Samples of the same facets stand together.
        for run in self.samples.chunk_by(|a, b| a.shows() == b.shows()) {
            if run[0].is_inside() {
                self.sum_run::<INSIDE>(scene, state, run, &mut sums);
            } else {
                self.sum_run::<ACROSS>(scene, state, run, &mut sums);
            }
        }
        sums
    }

    #[inline(always)]
    fn sum_run<const ROW: usize>(
        &self,
        scene: &Scene<'_>,
        state: &State,
        run: &[Sample],
        sums: &mut Sums,
    ) {
        let mut bundle: Option<Bundle<ROW>> = None;
        for sample in run {
            let direction = sample.direction(self.patch);
            let behind = f64::from(sample.behind);
            let seams = sample.seams(self.print);
            let modelled = model(scene, state, sample.facets(), seams, behind, &direction);
            let residual = f64::from(sample.light) - modelled.light;
            sums.residuals.push(residual as f32);
            let precision = 1.0 / self.scales[usize::from(sample.facet)].powi(2);
            let damping = if self.is_robust { damping(residual.powi(2) * precision) } else { 0.0 };
            let weight = precision / (1.0 + damping);
            let mut row = [0.0f32; ROW];
            for (value, by) in row.iter_mut().zip(modelled.by_common) {
                *value = by as f32;
            }
            for (value, by) in row[COMMON..].iter_mut().zip(modelled.by_slope) {
                *value = by as f32;
            }
            for (k, &(_, by_white, by_black)) in modelled.levels().iter().enumerate() {
                row[LEVELS + 2 * k] = by_white as f32;
                row[LEVELS + 2 * k + 1] = by_black as f32;
            }
            for (k, &(_, by_seam)) in modelled.seams().iter().enumerate() {
                row[ROW - 3 + k] = by_seam as f32;
            }
            row[ROW - 1] = residual as f32;
            let facet = usize::from(sample.facet);
            let bundle = bundle.get_or_insert_with(|| Bundle::new(facet, &modelled, self.layout));
            bundle.add(&row, weight as f32);
        }
        if let Some(bundle) = bundle {
            bundle.add_to(sums);
        }
    }
}
