//! Rolls of square views about their axes, with which the squares can be smallest.
//!
//! Circles are not affected by rolls. Squares reach farther along their diagonals, so each is
//! rotated until its corners reach into the holes between circles. Rolls are found on samples of
//! the sphere. The exact bound of [`super::squares`] repeatedly adds its worst points to them.

use nalgebra::Vector3;

use super::hull::{Triangle, covering_cosine};
use super::squares::{Square, half_field};
use crate::random::Chance;
use crate::view::upright_axes;

/// Half of the margin for which rolls are made: a marker of 5 cm at 40 cm.
const HALF_MARGIN_RAD: f64 = 0.0625;

/// Approximate number of samples of the sphere.
const SAMPLES: usize = 2_500;

/// Number of rolls tried in a sweep. Each is the tangent of half its angle, which needs no sine or
/// cosine; 1 is a quarter turn, equal to no turn.
const CANDIDATES: usize = 32;

/// Rolls, degrees from 0 to 90 to four decimals, of upright views along `points`.
pub(super) fn degrees(
    points: &[Vector3<f64>],
    facets: &[Triangle],
    seed: u64,
    takes_long: bool,
) -> Vec<f64> {
    // The search has rounds with random starts. Then each round's best is improved this many times
    // on its worst points. The long search is for the stored partitions. The short one is
    // acceptable at the start of the pipeline; its squares are about one degree larger.
    let (rounds, starts, exchanges) = if takes_long { (8, 8, 24) } else { (1, 4, 8) };
    let mut samples = samples(points, facets);
    let enough = HALF_MARGIN_RAD + covering_cosine(facets).acos();
    let limit = if enough < 1.48 { enough.tan() } else { f64::INFINITY };
    let mut random = Chance::stream(seed, u64::MAX);
    let mut least = (f64::INFINITY, vec![0.0; points.len()]);
    for _ in 0..rounds {
        let mut best: Option<(f64, Vec<f64>)> = None;
        for _ in 0..starts {
            let rolls = points.iter().map(|_| random.unit()).collect();
            let mut turning = Turning::new(&samples, limit, points, rolls);
            while turning.sweep(5, |_, k| k as f64 / CANDIDATES as f64, CANDIDATES) {}
            turning.refine(6);
            let worst = turning.worst();
            if best.as_ref().is_none_or(|best| worst < best.0) {
                best = Some((worst, turning.rolls));
            }
        }
        let Some((_, mut rolls)) = best else { break };
        for _ in 0..exchanges {
            let mut turning = Turning::new(&samples, limit, points, rolls);
            turning.refine(8);
            rolls = turning.rolls;
            let squares: Vec<_> =
                points.iter().zip(&rolls).map(|(p, &roll)| square(p, roll)).collect();
            let Some(field) = half_field(&squares, points, facets, HALF_MARGIN_RAD, 1e-4) else {
                break;
            };
            if field.certified_tan() < least.0 {
                least = (field.certified_tan(), rolls.clone());
            }
            samples.extend(field.worst.iter().rev().take(8));
        }
    }
    least
        .1
        .iter()
        .map(|half_tan| (2.0 * half_tan.atan().to_degrees() * 1e4).round() / 1e4)
        .collect()
}

/// The square along `point` whose roll has this tangent of its half-angle.
fn square(point: &Vector3<f64>, half_tan: f64) -> Square {
    let square = half_tan * half_tan;
    let turn = ((1.0 - square) / (1.0 + square), 2.0 * half_tan / (1.0 + square));
    Square::new(upright_axes(point), turn)
}

/// Sample directions for the needs of the views: the holes, and a grid in each facet.
fn samples(directions: &[Vector3<f64>], facets: &[Triangle]) -> Vec<Vector3<f64>> {
    let steps = ((2 * SAMPLES / facets.len()) as f64).sqrt().ceil() as usize;
    let mut points: Vec<_> = facets.iter().map(|facet| facet.normal).collect();
    for facet in facets {
        let [a, b, c] = facet.corners.map(|corner| directions[corner]);
        for i in 0..=steps {
            for j in 0..=steps - i {
                let point = a * i as f64 + b * j as f64 + c * (steps - i - j) as f64;
                points.push(point / point.norm_squared().sqrt());
            }
        }
    }
    points
}

/// State of the search for the rolls of the smallest squares.
struct Turning<'a> {
    points: &'a [Vector3<f64>],
    samples: &'a [Vector3<f64>],
    /// Tangent of the half-field of the circumscribed squares.
    limit: f64,
    sin_half: f64,
    /// Tangents of half the rolls.
    rolls: Vec<f64>,
    /// Samples that each view may serve.
    near: Vec<Vec<usize>>,
    /// Views that may serve each sample, with the half-field tangents that they need at present.
    needed: Vec<Vec<(usize, f64)>>,
}

impl<'a> Turning<'a> {
    fn new(
        samples: &'a [Vector3<f64>],
        limit: f64,
        points: &'a [Vector3<f64>],
        rolls: Vec<f64>,
    ) -> Self {
        let sin_half = HALF_MARGIN_RAD.sin();
        let mut near = vec![Vec::new(); points.len()];
        let mut needed = vec![Vec::new(); samples.len()];
        let level = Square::new([Vector3::x(), Vector3::y(), Vector3::z()], (1.0, 0.0));
        for (index, sample) in samples.iter().enumerate() {
            for (view, point) in points.iter().enumerate() {
                // A sample on a diagonal needs the least.
                let z = point.dot(sample);
                let x = ((1.0 - z * z).max(0.0) / 2.0).sqrt();
                if level.needed(&Vector3::new(x, x, z), sin_half) <= limit {
                    near[view].push(index);
                    let now = square(point, rolls[view]).needed(sample, sin_half);
                    needed[index].push((view, now));
                }
            }
        }
        Self { points, samples, limit, sin_half, rolls, near, needed }
    }

    /// Tangent of the half-field that the worst sample needs.
    fn worst(&self) -> f64 {
        let best = |views: &Vec<(usize, f64)>| {
            views.iter().map(|&(_, needed)| needed).fold(f64::INFINITY, f64::min)
        };
        self.needed.iter().map(best).fold(0.0, f64::max)
    }

    /// Rotates each view in turn to the candidate with which its samples need the least, in the
    /// mean of the 2^`doublings`-th power. True if a view was rotated.
    fn sweep(
        &mut self,
        doublings: u32,
        candidate: impl Fn(f64, usize) -> f64,
        count: usize,
    ) -> bool {
        let mut has_turned = false;
        for view in 0..self.points.len() {
            let others: Vec<(usize, f64)> = self.near[view]
                .iter()
                .map(|&sample| {
                    let others = self.needed[sample].iter().filter(|(other, _)| *other != view);
                    (sample, others.map(|&(_, needed)| needed).fold(f64::INFINITY, f64::min))
                })
                .collect();
            let present = self.rolls[view];
            let mut best = (self.cost(view, present, &others, doublings, f64::INFINITY), present);
            for index in 0..count {
                let roll = candidate(present, index);
                let cost = self.cost(view, roll, &others, doublings, best.0);
                if cost < best.0 * (1.0 - 1e-9) {
                    best = (cost, roll);
                }
            }
            if best.1 != present {
                has_turned = true;
                self.rolls[view] = best.1;
                let square = square(&self.points[view], best.1);
                for &sample in &self.near[view] {
                    let now = square.needed(&self.samples[sample], self.sin_half);
                    for entry in self.needed[sample].iter_mut().filter(|entry| entry.0 == view) {
                        entry.1 = now;
                    }
                }
            }
        }
        has_turned
    }

    fn refine(&mut self, doublings: u32) {
        for step in [1e-2, 3e-3, 1e-3, 3e-4, 1e-4] {
            let aside = |roll: f64, index: usize| {
                let moved: f64 = if index == 0 { roll + step } else { roll - step };
                // A quarter turn equals no turn.
                moved - moved.floor()
            };
            for _ in 0..20 {
                if !self.sweep(doublings, aside, 2) {
                    break;
                }
            }
        }
    }

    /// Sum over the view's samples of their needs to the 2^`doublings`-th power, infinite beyond
    /// `limit`.
    fn cost(
        &self,
        view: usize,
        roll: f64,
        others: &[(usize, f64)],
        doublings: u32,
        limit: f64,
    ) -> f64 {
        let square = square(&self.points[view], roll);
        let scale = 1.0 / self.limit.min(10.0);
        let mut sum = 0.0;
        for &(sample, other) in others {
            let needed = square.needed(&self.samples[sample], self.sin_half).min(other);
            let mut power = needed.min(1e3) * scale;
            for _ in 0..doublings {
                power *= power;
            }
            sum += power;
            if sum > limit {
                return f64::INFINITY;
            }
        }
        sum
    }
}
