//! Start poses of an alignment for a body with a rough place.
//!
//! Far away, in the dark or in glare no marker is found, though a body with a pattern is visible.
//! This search compares the picture with the body in all attitudes ([`templates`]). It works in a
//! *canonical picture* of one pixel for each cell of the body's smallest marker, with more blur
//! than a lens leaves there. So the usual body is 23 pixels across, whatever its distance, and none
//! is more than 32.
//!
//! 1. Coarse: each attitude, turn about the line of sight, range and second pixel ([`coarse`]).
//! 2. Fine: the best of these again at half the steps ([`fine`]).
//! 3. The best that differ are the starts, best first. The choice between them is left to alignment
//!    and its evidence.

mod canvas;
mod correlation;
mod templates;

use nalgebra::{Isometry3, Vector3};

use super::patch::Patch;
use canvas::{Canvases, GridPose, RANGE_EXPONENTS, TURNS};
use templates::Template;
pub use templates::Templates;

/// Number of coarse cells that are refined.
const KEPT: usize = 1500;
/// Number of starts for each kind of template.
const STARTS: usize = 8;
/// Differences below which two starts are the same: radians, and cells across the line of sight.
const SAME_RAD: f64 = 0.3;
const SAME_CELLS: f64 = 2.5;
/// Share of saturated pixels of the patch above which overexposed templates are tried.
const SATURATED_SHARE: f64 = 0.02;

/// A place where a body may be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Place {
    /// Direction of its middle, in the camera frame, within two thirds of a body's radius; unit
    /// length.
    pub direction_in_camera: Vector3<f64>,
    /// Distance, metres, within a third.
    pub range_m: f64,
}

/// Start poses (`patch_from_markers`), the likeliest of each kind of template first. `middle` is
/// the place's direction in the patch, `lens_px` the lens's blur in it.
pub(super) fn starts(
    templates: &Templates,
    patch: &Patch,
    middle: &Vector3<f64>,
    range_m: f64,
    lens_px: f64,
) -> Vec<Isometry3<f64>> {
    let Some(centre_px) = patch.pinhole.project(middle) else { return Vec::new() };
    let mut canvases = Canvases::new(templates.size, patch, centre_px, range_m, lens_px);
    let mut starts = starts_of(&templates.plain, &mut canvases);
    if patch.saturated_share() > SATURATED_SHARE {
        starts.extend(starts_of(&templates.overexposed, &mut canvases));
    }
    starts
}

/// The starts of one kind of template.
fn starts_of(templates: &[Template], canvases: &mut Canvases<'_>) -> Vec<Isometry3<f64>> {
    let mut cells = coarse(templates, canvases);
    for cell in &mut cells {
        *cell = fine(templates, canvases, cell);
    }
    cells.sort_by(|a, b| b.score.total_cmp(&a.score));
    let mut starts: Vec<Isometry3<f64>> = Vec::new();
    for cell in cells {
        if starts.len() >= STARTS {
            break;
        }
        let start = canvases.pose(&templates[cell.template].sight_from_markers, &cell);
        if !starts.iter().any(|other| is_same(other, &start, canvases.size.cell_m)) {
            starts.push(start);
        }
    }
    starts
}

/// The best cells of the coarse grid.
fn coarse(templates: &[Template], canvases: &mut Canvases<'_>) -> Vec<GridPose> {
    let mut cells: Vec<GridPose> = Vec::new();
    let mut least = 0.0;
    for exponent in (RANGE_EXPONENTS.0..=RANGE_EXPONENTS.1).step_by(2) {
        for turn in (0..TURNS).step_by(2) {
            let canvas = canvases.get(turn, exponent);
            for (number, template) in templates.iter().enumerate() {
                let (score, shift) = correlation::best_shift(template, canvas);
                if score > least {
                    cells.push(GridPose { template: number, turn, exponent, shift, score });
                }
            }
            if cells.len() > 2 * KEPT {
                cells.select_nth_unstable_by(KEPT, |a, b| b.score.total_cmp(&a.score));
                least = cells[KEPT].score;
                cells.truncate(KEPT);
            }
        }
    }
    cells.sort_by(|a, b| b.score.total_cmp(&a.score));
    cells.truncate(KEPT);
    cells
}

/// The best cell of the fine grid beside a coarse one.
fn fine(templates: &[Template], canvases: &mut Canvases<'_>, coarse: &GridPose) -> GridPose {
    let mut best = *coarse;
    for exponent in coarse.exponent - 1..=coarse.exponent + 1 {
        for turn in [coarse.turn + TURNS - 1, coarse.turn, coarse.turn + 1] {
            let turn = turn % TURNS;
            let canvas = canvases.get(turn, exponent);
            let template = &templates[coarse.template];
            let (score, shift) = correlation::best_beside(template, canvas, coarse.shift);
            if score > best.score {
                best = GridPose { turn, exponent, shift, score, ..*coarse };
            }
        }
    }
    best
}

/// Whether two starts are too close to lead to different poses.
fn is_same(one: &Isometry3<f64>, other: &Isometry3<f64>, cell_m: f64) -> bool {
    let (here, there) = (one.translation.vector, other.translation.vector);
    let apart_rad = (here.normalize() - there.normalize()).norm();
    one.rotation.angle_to(&other.rotation) < SAME_RAD
        && apart_rad * here.norm() < SAME_CELLS * cell_m
}

#[cfg(test)]
mod tests;
