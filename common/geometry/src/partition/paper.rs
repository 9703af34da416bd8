//! The paper's method (section III-A): spread the centres, then grow the circles.

use nalgebra::Vector3;

use crate::random::Chance;

/// The first factor by which the two closest centres are separated.
const FIRST_FACTOR: f64 = 0.05;
/// The factor at which the distances have converged.
const LAST_FACTOR: f64 = 1e-7;
/// Number of pushes per centre without progress after which the factor is halved.
const PATIENCE: usize = 20;

/// "The circle centers are initialized randomly across the surface of the sphere. Through an
/// iterative process, the two closest centers are separated by a constant factor until
/// convergence."
///
/// With one fixed factor the centres would oscillate by that factor. So it is constant only as long
/// as it helps, then halved. There is one random start, as in the paper: another seed may end in
/// another local optimum. The result spreads points (the Tammes problem), which differs from
/// covering with the smallest circles.
pub(super) fn directions(count: usize, seed: u64) -> Vec<Vector3<f64>> {
    let mut random = Chance::stream(seed, 0);
    let mut centres = Centres::new((0..count).map(|_| random.portable_direction()).collect());
    let mut best = (centres.closest().1, centres.points.clone());
    let mut factor = FIRST_FACTOR;
    let mut in_vain = 0;
    while factor > LAST_FACTOR {
        centres.separate(centres.closest().0, factor);
        let (_, cosine) = centres.closest();
        if cosine < best.0 {
            best = (cosine, centres.points.clone());
            in_vain = 0;
        } else {
            in_vain += 1;
        }
        if in_vain > PATIENCE * count {
            centres = Centres::new(best.1.clone());
            factor /= 2.0;
            in_vain = 0;
        }
    }
    best.1
}

/// The centres, each with its nearest neighbour.
struct Centres {
    points: Vec<Vector3<f64>>,
    /// Number of each centre's nearest neighbour, and the cosine of the angle between the two.
    nearest: Vec<(usize, f64)>,
}

impl Centres {
    fn new(points: Vec<Vector3<f64>>) -> Self {
        let nearest = (0..points.len()).map(|a| nearest(&points, a)).collect();
        Self { points, nearest }
    }

    /// The two closest centres, those with lower numbers in a tie, and the cosine between them.
    fn closest(&self) -> ([usize; 2], f64) {
        let (b, cosine) = self.nearest[0];
        let mut closest = ([0, b], cosine);
        for (a, &(b, cosine)) in self.nearest.iter().enumerate() {
            if cosine > closest.1 {
                closest = ([a, b], cosine);
            }
        }
        closest
    }

    /// Moves both of a pair outwards, so that their distance grows by `factor`.
    fn separate(&mut self, pair: [usize; 2], factor: f64) {
        let push = (self.points[pair[0]] - self.points[pair[1]]) * (factor / 2.0);
        for (index, push) in [(pair[0], push), (pair[1], -push)] {
            let moved = self.points[index] + push;
            self.points[index] = moved / moved.norm_squared().sqrt();
        }
        for a in 0..self.points.len() {
            if pair.contains(&a) || pair.contains(&self.nearest[a].0) {
                self.nearest[a] = nearest(&self.points, a);
            } else {
                for b in pair {
                    let cosine = self.points[a].dot(&self.points[b]);
                    if cosine > self.nearest[a].1 {
                        self.nearest[a] = (b, cosine);
                    }
                }
            }
        }
    }
}

fn nearest(points: &[Vector3<f64>], a: usize) -> (usize, f64) {
    let mut nearest = (a, -2.0);
    for (b, point) in points.iter().enumerate() {
        let cosine = points[a].dot(point);
        if b != a && cosine > nearest.1 {
            nearest = (b, cosine);
        }
    }
    nearest
}

#[cfg(test)]
mod tests {
    use super::*;

    fn separation_deg(count: usize, seed: u64) -> f64 {
        Centres::new(directions(count, seed)).closest().1.acos().to_degrees()
    }

    #[test]
    fn points_spread_as_far_as_is_known() {
        // Tammes' problem: Schuette and van der Waerden (1951), Robinson (1961) for 24. The best
        // of a few seeds: one start may end in a local optimum.
        for (count, known) in
            [(4, 109.4712), (6, 90.0), (8, 74.8585), (9, 70.5288), (12, 63.4349), (24, 43.6908)]
        {
            let best = (0..12).map(|seed| separation_deg(count, seed)).fold(0.0, f64::max);
            assert!((best - known).abs() < 0.01, "{count}: {best} against {known}");
        }
    }
}
