//! Groups of squares at distances like those of a body's squares.

use nalgebra::{Unit, Vector3};

use super::proposal::{MarkerSizes, Proposal};
use super::squares::DarkSquare;

/// Number of a body's squares whose appearance counts: those with the most contrast.
const MOST_SQUARES: usize = 6;

/// Largest ratio between the sides of squares of one body: some are seen at an angle.
const MAX_SIDE_RATIO: f64 = 2.5;

/// Radius within which other squares belong to the same body, and radius up to which they are its
/// surroundings, in radii of the body. Windows and tiles have more similar squares in the
/// surroundings.
const NEAR_RADII: f64 = 1.6;
const BESIDE_RADII: f64 = 3.6;

/// Distance below which two squares are outlines of the same one, sides.
const SAME_SIDES: f64 = 0.4;

// Weight of each feature of a proposal, from a logistic regression over proposals in simulated,
// rendered and photographed scenes (docs/FUSION.md). All but the last weigh logarithms.
const WEIGHT_OF_SQUARES: f64 = 1.0;
const WEIGHT_OF_BESIDE: f64 = -1.3;
const WEIGHT_OF_TEXTURE: f64 = 1.9;
const WEIGHT_OF_GRAIN: f64 = 1.0;
const WEIGHT_OF_SIDE: f64 = 1.0;
const WEIGHT_OF_UNEVENNESS: f64 = 6.0;

/// Groups squares to proposals: the best first, at most `most`.
pub(super) fn cluster(
    squares: &mut [DarkSquare],
    sizes: &MarkerSizes,
    most: usize,
) -> Vec<Proposal> {
    // Sorted from the nadir to the zenith, so that neighbours are near each other in the order.
    squares.sort_by(|a, b| a.direction_in_camera.z.total_cmp(&b.direction_in_camera.z));
    let mut found: Vec<Proposal> =
        (0..squares.len()).map(|place| proposal(squares, place, sizes)).collect();
    found.sort_by(|a, b| b.score.total_cmp(&a.score));
    let mut kept: Vec<Proposal> = Vec::new();
    for proposal in found {
        if kept.len() >= most {
            break;
        }
        let is_new = |other: &Proposal| {
            let apart = other.direction_in_camera.angle(&proposal.direction_in_camera);
            apart > 2.0 * sizes.radius_in_sides * other.side_rad.max(proposal.side_rad)
        };
        if kept.iter().all(is_new) {
            kept.push(proposal);
        }
    }
    kept
}

/// Cluster of the square at an index of the order, with its neighbours.
fn proposal(squares: &[DarkSquare], place: usize, sizes: &MarkerSizes) -> Proposal {
    let own = &squares[place];
    let from = own.direction_in_camera.into_inner();
    let radius = sizes.radius_in_sides * own.side_rad;
    let (mut count, mut best) = (1u32, [None; MOST_SQUARES]);
    keep_best(&mut best, own);
    let mut middle: Vector3<f64> = from;
    let mut beside = 0;
    let is_near =
        |other: &&DarkSquare| (other.direction_in_camera.z - from.z).abs() < BESIDE_RADII * radius;
    let above = squares[place + 1..].iter().take_while(is_near);
    let below = squares[..place].iter().rev().take_while(is_near);
    for other in above.chain(below) {
        let apart = (other.direction_in_camera.into_inner() - from).norm();
        let ratio = other.side_rad / own.side_rad;
        let is_alike = (1.0 / MAX_SIDE_RATIO..=MAX_SIDE_RATIO).contains(&ratio);
        if !is_alike || apart < SAME_SIDES * own.side_rad || apart > BESIDE_RADII * radius {
            continue;
        }
        if apart < NEAR_RADII * radius {
            count += 1;
            keep_best(&mut best, other);
            middle += other.direction_in_camera.into_inner();
        } else {
            beside += 1;
        }
    }
    let shown = best.iter().flatten().count() as f64;
    let mean = |of: fn(&DarkSquare) -> f32| {
        best.iter().flatten().map(|square| f64::from(of(square))).sum::<f64>() / shown
    };
    let texture = mean(|square| square.texture);
    let grain = mean(|square| square.grain);
    let unevenness = mean(|square| square.unevenness);
    let score = WEIGHT_OF_SQUARES * f64::from(count).ln()
        + WEIGHT_OF_BESIDE * f64::from(1 + beside).ln()
        + WEIGHT_OF_TEXTURE * texture.max(1.0).ln()
        + WEIGHT_OF_GRAIN * grain.max(1.0).ln()
        + WEIGHT_OF_SIDE * own.side_rad.ln()
        + WEIGHT_OF_UNEVENNESS * unevenness;
    Proposal { direction_in_camera: Unit::new_normalize(middle), side_rad: own.side_rad, score }
}

/// Inserts a square among those with the most contrast, if there is room.
fn keep_best<'s>(best: &mut [Option<&'s DarkSquare>; MOST_SQUARES], square: &'s DarkSquare) {
    let contrast = |square: &Option<&DarkSquare>| square.map_or(0.0, |square| square.contrast);
    let mut new = Some(square);
    for place in best {
        if contrast(&new) > contrast(place) {
            std::mem::swap(place, &mut new);
        }
    }
}
