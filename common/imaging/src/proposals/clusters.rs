//! Squares that lie as near to each other as those of a body.

use nalgebra::{Unit, Vector3};

use super::proposal::{MarkerSizes, Proposal};
use super::squares::Square;

/// Squares of a body whose looks count: those with the most contrast.
const MOST_SQUARES: usize = 6;

/// Sides of squares of one body differ by this ratio at most: some are seen at an angle.
const MAX_SIDE_RATIO: f64 = 2.5;

/// From a square, others of its body are this near, and what lies beyond, up to the second, is not of its
/// body, radii. Windows and tiles have more of their like there.
const NEAR_RADII: f64 = 1.6;
const BESIDE_RADII: f64 = 3.6;

/// A square that is nearer than this is another outline of the same one, sides.
const SAME_SIDES: f64 = 0.4;

/// How much each of a proposal's looks counts for it.
struct Weights {
    squares: f64,
    beside: f64,
    texture: f64,
    grain: f64,
    side: f64,
    unevenness: f64,
}

/// From a logistic regression over proposals in simulated, rendered and photographed scenes
/// (docs/FUSION.md). All but the last weigh logarithms.
const WEIGHTS: Weights =
    Weights { squares: 1.0, beside: -1.3, texture: 1.9, grain: 1.0, side: 1.0, unevenness: 6.0 };

/// Groups squares to proposals: the best first, at most `most`.
pub(super) fn cluster(squares: &mut [Square], sizes: &MarkerSizes, most: usize) -> Vec<Proposal> {
    // From the nadir to the zenith, so that neighbours on the sphere are near each other in the order.
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

/// The square at a place in the order, with those round it.
fn proposal(squares: &[Square], place: usize, sizes: &MarkerSizes) -> Proposal {
    let own = &squares[place];
    let from = own.direction_in_camera.into_inner();
    let radius = sizes.radius_in_sides * own.side_rad;
    let mut members = Members::default();
    members.add(own);
    let mut middle: Vector3<f64> = from;
    let mut beside = 0;
    let is_near =
        |other: &&Square| (other.direction_in_camera.z - from.z).abs() < BESIDE_RADII * radius;
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
            members.add(other);
            middle += other.direction_in_camera.into_inner();
        } else {
            beside += 1;
        }
    }
    let [texture, grain, unevenness] = members.means();
    let score = WEIGHTS.squares * f64::from(members.count).ln()
        + WEIGHTS.beside * f64::from(1 + beside).ln()
        + WEIGHTS.texture * texture.max(1.0).ln()
        + WEIGHTS.grain * grain.max(1.0).ln()
        + WEIGHTS.side * own.side_rad.ln()
        + WEIGHTS.unevenness * unevenness;
    Proposal { direction_in_camera: Unit::new_normalize(middle), side_rad: own.side_rad, score }
}

/// The squares of a proposal, of which those with the most contrast are kept.
#[derive(Default)]
struct Members<'s> {
    count: u32,
    best: [Option<&'s Square>; MOST_SQUARES],
}

impl<'s> Members<'s> {
    fn add(&mut self, square: &'s Square) {
        self.count += 1;
        let mut new = Some(square);
        for place in &mut self.best {
            let contrast = |square: &Option<&Square>| square.map_or(0.0, |square| square.contrast);
            if contrast(&new) > contrast(place) {
                std::mem::swap(place, &mut new);
            }
        }
    }

    /// The means of texture, grain and unevenness.
    fn means(&self) -> [f64; 3] {
        let best = || self.best.iter().flatten();
        let count = best().count().max(1) as f64;
        let mean = |of: fn(&Square) -> f32| {
            best().map(|square| f64::from(of(square))).sum::<f64>() / count
        };
        [
            mean(|square| square.texture),
            mean(|square| square.grain),
            mean(|square| square.unevenness),
        ]
    }
}
