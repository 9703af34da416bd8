//! The normal equations, summed over samples.
//!
//! Samples that show the same facets depend on the same few unknowns. They are first summed in a
//! block of fixed size, which the compiler vectorizes, and the block is added to the full matrix
//! once.

use nalgebra::{DMatrix, DVector, Isometry3, Matrix6, SMatrix, Vector6};

use super::model::{Modelled, Scene, model};
use super::patch::Patch;
use super::robust::cauchy_term;
use super::samples::Sample;
use super::state::{COMMON, CONSTANTS, Layout, State};

/// Row of a pixel of one facet: common unknowns, two gradients, two levels, the residual.
const INSIDE: usize = LEVELS + 2 + 1;
/// Length of the row of a pixel that shows up to three facets: six levels and two seams.
const ACROSS: usize = LEVELS + 6 + 2 + 1;
/// Index of the first level in a row.
const LEVELS: usize = COMMON + 2;

/// The normal equations `normal * step = right`.
pub(super) struct PoseEquations {
    pub normal: DMatrix<f64>,
    pub right: DVector<f64>,
    /// Residual of each sample, radiance; `None` where a sample is not usable
    /// ([`Sample::counted`]).
    pub residuals: Vec<Option<f32>>,
}

/// The samples of a fit, and the unknowns that they determine.
pub(super) struct SampleSet {
    pub samples: Vec<Sample>,
    pub layout: Layout,
    /// Residual sigma of each facet.
    pub sigmas: Vec<f64>,
    /// The pose at which the samples were chosen.
    pub chosen_at: Isometry3<f64>,
}

/// Sums over pixels that depend on the same unknowns. A row has `ROW` numbers, the residual last.
struct Block<const ROW: usize> {
    /// Index of the unknown that each number of the row belongs to.
    indices: [Option<usize>; ROW],
    products: [[f32; ROW]; ROW],
}

impl<const ROW: usize> Block<ROW> {
    /// A block for pixels that lie on this facet.
    fn new(facet: usize, modelled: &Modelled, layout: &Layout) -> Self {
        let mut indices = [None; ROW];
        for (k, index) in indices.iter_mut().enumerate().take(COMMON) {
            *index = Some(k);
        }
        let gradient = layout.gradient(facet);
        indices[COMMON] = gradient;
        indices[COMMON + 1] = gradient.map(|at| at + 1);
        for (k, &(facet, ..)) in modelled.levels().iter().enumerate() {
            let at = layout.levels[facet];
            indices[LEVELS + 2 * k] = at;
            indices[LEVELS + 2 * k + 1] = at.map(|at| at + 1);
        }
        for (k, &(seam, _)) in modelled.seams().iter().enumerate() {
            indices[ROW - 3 + k] = layout.seams[seam];
        }
        Self { indices, products: [[0.0; ROW]; ROW] }
    }

    #[inline(always)]
    fn add(&mut self, row: &[f32; ROW], weight: f32) {
        // The whole matrix is summed, not half of it, so that the compiler can vectorize it.
        for (products, first) in self.products.iter_mut().zip(row) {
            let weighted = weight * first;
            for (product, second) in products.iter_mut().zip(row) {
                *product += weighted * second;
            }
        }
    }

    fn add_to(&self, sums: &mut PoseEquations) {
        for (row, at) in self.indices.iter().enumerate() {
            let Some(at) = *at else { continue };
            for (column, to) in self.indices.iter().enumerate() {
                if let Some(to) = *to {
                    sums.normal[(at, to)] += f64::from(self.products[row][column]);
                }
            }
            sums.right[at] += f64::from(self.products[row][ROW - 1]);
        }
    }
}

impl<const ROW: usize> Block<ROW> {
    /// Adds the rows and columns of the constants of a stitched camera, which begin at the index `at`.
    /// Their derivatives are `by_constants` times those of the pose.
    fn add_constants(
        &self,
        at: usize,
        by_constants: &SMatrix<f64, CONSTANTS, 6>,
        sums: &mut PoseEquations,
    ) {
        let of_pose =
            |column: usize| Vector6::from_fn(|row, _| f64::from(self.products[row][column]));
        for (column, to) in self.indices.iter().enumerate() {
            let Some(to) = *to else { continue };
            let products = by_constants * of_pose(column);
            for k in 0..CONSTANTS {
                sums.normal[(at + k, to)] += products[k];
                sums.normal[(to, at + k)] += products[k];
            }
        }
        let among_pose = Matrix6::from_fn(|row, column| f64::from(self.products[row][column]));
        let mut own = sums.normal.fixed_view_mut::<CONSTANTS, CONSTANTS>(at, at);
        own += by_constants * among_pose * by_constants.transpose();
        let mut right = sums.right.fixed_rows_mut::<CONSTANTS>(at);
        right += by_constants * of_pose(ROW - 1);
    }
}

impl SampleSet {
    /// Sums the normal equations at a state.
    pub(super) fn sum(&self, patch: &Patch, scene: &Scene<'_>, state: &State) -> PoseEquations {
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: the line above checked that the processor has AVX2.
            return unsafe { self.sum_avx2(patch, scene, state) };
        }
        self.sum_plain(patch, scene, state)
    }

    /// The portable code, compiled for AVX2. Its sums are equal to the last bit.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn sum_avx2(&self, patch: &Patch, scene: &Scene<'_>, state: &State) -> PoseEquations {
        self.sum_plain(patch, scene, state)
    }

    #[inline(always)]
    fn sum_plain(&self, patch: &Patch, scene: &Scene<'_>, state: &State) -> PoseEquations {
        let unknowns = self.layout.count;
        let mut sums = PoseEquations {
            normal: DMatrix::zeros(unknowns, unknowns),
            right: DVector::zeros(unknowns),
            residuals: Vec::with_capacity(self.samples.len()),
        };
        // Samples that show the same facets are neighbours in the list.
        for run in self.samples.chunk_by(|a, b| a.shows() == b.shows()) {
            if run[0].is_inside() {
                self.sum_run::<INSIDE>(patch, scene, state, run, &mut sums);
            } else {
                self.sum_run::<ACROSS>(patch, scene, state, run, &mut sums);
            }
        }
        sums
    }

    #[inline(always)]
    fn sum_run<const ROW: usize>(
        &self,
        patch: &Patch,
        scene: &Scene<'_>,
        state: &State,
        run: &[Sample],
        sums: &mut PoseEquations,
    ) {
        let mut block: Option<Block<ROW>> = None;
        for sample in run {
            let direction = sample.direction(patch);
            let background = f64::from(sample.background);
            let seams = sample.seams(scene.print);
            let half = usize::from(sample.half);
            let modelled =
                model(scene, state, half, sample.facets(), seams, background, &direction);
            let residual = sample.counted(f64::from(sample.radiance) - modelled.radiance);
            sums.residuals.push(residual.map(|residual| residual as f32));
            let Some(residual) = residual else { continue };
            let precision = 1.0 / self.sigmas[usize::from(sample.facet)].powi(2);
            let weight = precision / (1.0 + cauchy_term(residual.powi(2) * precision));
            let mut row = [0.0f32; ROW];
            for (value, by) in row.iter_mut().zip(modelled.by_common) {
                *value = by as f32;
            }
            for (value, by) in row[COMMON..].iter_mut().zip(modelled.by_gradient) {
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
            let block = block.get_or_insert_with(|| Block::new(facet, &modelled, &self.layout));
            block.add(&row, weight as f32);
        }
        if let Some(block) = block {
            block.add_to(sums);
            if let Some(at) = self.layout.constants {
                let by_constants = patch.halves.by_constants(usize::from(run[0].half));
                block.add_constants(at, &by_constants, sums);
            }
        }
    }
}
