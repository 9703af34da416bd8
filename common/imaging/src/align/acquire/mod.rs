//! Where alignment may start for a body of which only a rough place is known.
//!
//! Far away, in the dark or in glare no marker is found, but people still see a body with a pattern. This search sees
//! it too: it compares the picture with the body in all attitudes ([`templates`]). It works in a *canonical picture* of
//! one pixel for each cell of the body's smallest marker, with more blur than a lens leaves there. So the usual body is
//! 23 pixels across, whatever its distance, and none is more than 32.
//!
//! 1. Coarse: each attitude at each turn about the line of sight, each range and every second pixel
//!    ([`coarse`]). Where it is known how a body hangs, a fifth of these will do ([`Attitudes`]).
//! 2. Fine: the best of these again at half the steps ([`fine`]).
//! 3. The best that differ are the starts, best first. Which of them leads to the body is for alignment and its
//!    evidence to say.

mod canvas;
mod correlation;
mod templates;

use std::f64::consts::TAU;

use nalgebra::{Isometry3, Unit, UnitQuaternion, Vector3};

use super::patch::Patch;
use canvas::Canvases;
use templates::Template;
pub use templates::Templates;

/// Blur of the canonical picture, standard deviation, cells.
pub(super) const BLUR_CELLS: f64 = 0.85;
/// The body's middle is looked for so many cells to each side of the place.
const REACH_CELLS: usize = 11;
/// Ranges from the stated one, as powers of this. The coarse grid has every second power.
const RANGE_STEP: f64 = 1.075;
/// Exponents of the nearest and the farthest range of the coarse grid. A marker that is seen at an angle makes a place
/// seem farther away than it is, the box round one that stands on its corner makes it seem nearer.
const RANGE_EXPONENTS: (i32, i32) = (-6, 6);
/// Turns about the line of sight on the fine grid.
const TURNS: usize = 48;
/// Coarse cells that are looked at again, of all attitudes.
const KEPT: usize = 1500;
/// From an attitude to the nearest one of the coarse grid, about.
const HALF_STEP_RAD: f64 = 0.15;
/// Starts of each kind of template, of all attitudes.
const STARTS: usize = 8;
/// Of fewer attitudes there are fewer rivals, and these starts at least.
const LEAST_STARTS: usize = 3;
/// Starts that differ by less are one: radians, and cells across the line of sight.
const SAME_RAD: f64 = 0.3;
const SAME_CELLS: f64 = 2.5;
/// Overexposed templates are tried where more than this share of the patch is saturated.
const SATURATED_SHARE: f64 = 0.02;

/// A place where a body may be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Place {
    /// Where its middle is, in the camera frame, within two thirds of a body's radius; unit length.
    pub direction_in_camera: Vector3<f64>,
    /// How far away it is, metres, within a third.
    pub range_m: f64,
}

/// How a body hangs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Upright {
    /// Up on the observer, in the camera frame.
    pub up_in_camera: Unit<Vector3<f64>>,
    /// Up on the body, in its markers' frame.
    pub up_in_markers: Unit<Vector3<f64>>,
    /// The largest angle between the two, radians.
    pub max_tilt_rad: f64,
}

impl Upright {
    /// Whether a body hangs so in this attitude.
    pub fn holds(&self, camera_from_markers: &UnitQuaternion<f64>) -> bool {
        self.tilt_rad(camera_from_markers) <= self.max_tilt_rad
    }

    fn tilt_rad(&self, camera_from_markers: &UnitQuaternion<f64>) -> f64 {
        (camera_from_markers * self.up_in_markers).angle(&self.up_in_camera)
    }
}

/// In which attitudes a body is searched, about.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Attitudes {
    /// In all.
    Any,
    /// As it hangs.
    Upright(Upright),
    /// Near one.
    Near {
        /// This one, in the camera frame.
        camera_from_markers: UnitQuaternion<f64>,
        /// Turned by no more than this, radians.
        max_rad: f64,
    },
}

impl Attitudes {
    /// Whether an attitude is one of these, or one that is `slack_rad` away.
    fn include(&self, camera_from_markers: &UnitQuaternion<f64>, slack_rad: f64) -> bool {
        match self {
            Self::Any => true,
            Self::Upright(upright) => {
                upright.tilt_rad(camera_from_markers) <= upright.max_tilt_rad + slack_rad
            }
            Self::Near { camera_from_markers: middle, max_rad } => {
                camera_from_markers.angle_to(middle) <= max_rad + slack_rad
            }
        }
    }

    /// The same in the axes of a patch.
    pub(super) fn in_patch(&self, patch_from_camera: &UnitQuaternion<f64>) -> Self {
        match *self {
            Self::Any => Self::Any,
            Self::Upright(upright) => Self::Upright(Upright {
                up_in_camera: patch_from_camera * upright.up_in_camera,
                ..upright
            }),
            Self::Near { camera_from_markers, max_rad } => {
                Self::Near { camera_from_markers: patch_from_camera * camera_from_markers, max_rad }
            }
        }
    }
}

/// What is looked for in a patch.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sought {
    /// The place's direction in the patch.
    pub middle: Vector3<f64>,
    /// Its range, metres.
    pub range_m: f64,
    /// The lens's blur in the patch, pixels.
    pub lens_px: f64,
    /// Attitudes in the patch.
    pub attitudes: Attitudes,
}

/// A pose of the grid, with how well the picture agrees.
#[derive(Debug, Clone, Copy)]
struct Cell {
    template: usize,
    /// Turn about the line of sight, in fine steps.
    turn: usize,
    /// Exponent of the range.
    exponent: i32,
    /// Shift of the template in the canonical picture, pixels.
    shift: [usize; 2],
    score: f32,
}

/// Poses (`patch_from_markers`) to start from, the likeliest of each kind of template first.
pub(super) fn starts(templates: &Templates, patch: &Patch, sought: &Sought) -> Vec<Isometry3<f64>> {
    let Sought { middle, range_m, lens_px, .. } = *sought;
    let Some(centre_px) = patch.pinhole.project(&middle) else { return Vec::new() };
    let place = canvas::Place { patch, centre_px, range_m, lens_px };
    let mut canvases = Canvases::new(templates.size, &place);
    let mut starts = starts_of(&templates.plain, &mut canvases, sought);
    if patch.saturated_share() > SATURATED_SHARE {
        starts.extend(starts_of(&templates.overexposed, &mut canvases, sought));
    }
    starts
}

/// The starts of one kind of template.
fn starts_of(
    templates: &[Template],
    canvases: &mut Canvases<'_>,
    sought: &Sought,
) -> Vec<Isometry3<f64>> {
    let grid = Grid::of(templates, sought);
    let most = grid.of_all(STARTS).max(LEAST_STARTS);
    let mut cells = coarse(&grid, canvases);
    for cell in &mut cells {
        *cell = fine(templates, canvases, cell);
    }
    cells.sort_by(|a, b| b.score.total_cmp(&a.score));
    let mut starts: Vec<Isometry3<f64>> = Vec::new();
    for cell in cells {
        if starts.len() >= most {
            break;
        }
        let start = canvases.pose(&templates[cell.template].sight_from_markers, &cell);
        if !starts.iter().any(|other| is_same(other, &start, canvases.cell_m())) {
            starts.push(start);
        }
    }
    starts
}

/// The attitudes of the coarse grid.
struct Grid<'t> {
    templates: &'t [Template],
    /// The templates that are tried at each turn.
    at_turn: Vec<(usize, Vec<usize>)>,
    /// How many attitudes are tried.
    tried: usize,
}

impl<'t> Grid<'t> {
    fn of(templates: &'t [Template], sought: &Sought) -> Self {
        let holds = |template: &Template, turn: usize| {
            let attitude = lean(&sought.middle) * roll(turn) * template.sight_from_markers;
            // The right attitude may lie between those of the grid.
            sought.attitudes.include(&attitude, HALF_STEP_RAD)
        };
        let held = |turn| (0..templates.len()).filter(move |&k| holds(&templates[k], turn));
        let at_turn: Vec<(usize, Vec<usize>)> =
            (0..TURNS).step_by(2).map(|turn| (turn, held(turn).collect())).collect();
        let tried: usize = at_turn.iter().map(|(_, tried)| tried.len()).sum();
        Self { templates, at_turn, tried }
    }

    /// The part of a number that belongs to the attitudes that are tried, of one for all attitudes.
    fn of_all(&self, number: usize) -> usize {
        let all = self.templates.len() * self.at_turn.len();
        (number * self.tried).div_ceil(all.max(1))
    }
}

/// The best cells of the coarse grid.
fn coarse(grid: &Grid<'_>, canvases: &mut Canvases<'_>) -> Vec<Cell> {
    let kept = grid.of_all(KEPT);
    let mut cells: Vec<Cell> = Vec::new();
    let mut least = 0.0;
    for exponent in (RANGE_EXPONENTS.0..=RANGE_EXPONENTS.1).step_by(2) {
        for (turn, tried) in &grid.at_turn {
            let canvas = canvases.get(*turn, exponent);
            for &template in tried {
                let (score, shift) = correlation::best_shift(&grid.templates[template], canvas);
                if score > least {
                    cells.push(Cell { template, turn: *turn, exponent, shift, score });
                }
            }
            if cells.len() > 2 * kept {
                cells.select_nth_unstable_by(kept, |a, b| b.score.total_cmp(&a.score));
                least = cells[kept].score;
                cells.truncate(kept);
            }
        }
    }
    cells.sort_by(|a, b| b.score.total_cmp(&a.score));
    cells.truncate(kept);
    cells
}

/// The best cell of the fine grid beside a coarse one.
fn fine(templates: &[Template], canvases: &mut Canvases<'_>, coarse: &Cell) -> Cell {
    let mut best = *coarse;
    for exponent in coarse.exponent - 1..=coarse.exponent + 1 {
        for turn in [coarse.turn + TURNS - 1, coarse.turn, coarse.turn + 1] {
            let turn = turn % TURNS;
            let canvas = canvases.get(turn, exponent);
            let template = &templates[coarse.template];
            let (score, shift) = correlation::best_beside(template, canvas, coarse.shift);
            if score > best.score {
                best = Cell { turn, exponent, shift, score, ..*coarse };
            }
        }
    }
    best
}

/// Whether two starts are too near to each other to lead to different poses.
fn is_same(one: &Isometry3<f64>, other: &Isometry3<f64>, cell_m: f64) -> bool {
    let (here, there) = (one.translation.vector, other.translation.vector);
    let apart_rad = (here.normalize() - there.normalize()).norm();
    one.rotation.angle_to(&other.rotation) < SAME_RAD
        && apart_rad * here.norm() < SAME_CELLS * cell_m
}

/// The angle of a turn, radians.
fn turn_rad(turn: usize) -> f64 {
    turn as f64 / TURNS as f64 * TAU
}

/// A turn about the line of sight.
fn roll(turn: usize) -> UnitQuaternion<f64> {
    UnitQuaternion::from_axis_angle(&Vector3::z_axis(), turn_rad(turn))
}

/// The rotation that leads from the z axis to `sight` by the shortest way.
fn lean(sight: &Vector3<f64>) -> UnitQuaternion<f64> {
    // A patch looks ahead, so its pixels never look backwards.
    UnitQuaternion::rotation_between(&Vector3::z(), sight).unwrap_or_default()
}

#[cfg(test)]
mod tests;
